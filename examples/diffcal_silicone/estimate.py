"""Estimate the stiffness of a real silicone bar from pictures of it, and set it beside the published one.

The bar hangs under its weight (`recording.py` says which files of the recording are read). A reduced model
with the softness as its parameter is built once for each discretisation; softness and pose are then estimated
with the tracker's estimator from the bar's outline in a depth image, with its depths, and from the outline in
the colour views. No equation of mechanics is solved while estimating.

The published modulus was identified with linear tetrahedra on a coarse mesh, which are too stiff in bending.
The same elements are tried here, smaller ones, and elements that do not lock: the more the elements lock, the
softer is the silicone that explains the pictures. Last, the bar may turn in its clamp, which the model holds
rigid.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from bar_models import CONVERGED, FINER, PUBLISHED, Discretisation, bar_model
from fitting import MARKER_STD, Fit, fit
from numpy.typing import NDArray
from pictures import Picture, colour_picture, depth_picture
from recording import load_bar
from run import OUTPUT
from silicone import PUBLISHED_SHEAR

import morph_dslam as md
from morph_dslam.extend import reports, run_and_report_errors
from morph_dslam.extend.rendering import draw_overlay
from morph_dslam.extend.reports import Section, Table, Text, distances_to_surface, write_report
from support import data_folder

Array = NDArray[np.float64]

#: Width and height of what the pictures show, pixels.
SHOWN = np.array([700, 500])
#: How far the bar may turn in its clamp where that is not held to the marker, radians.
FREE_TURN = np.radians(10.0)
HEADER = ("elements", "picture", "turned by", "shear modulus", "95 % interval", "outline", "turn", "to the surface")


@dataclass(frozen=True)
class Case:
    """One estimate; ``distance`` (p,) of the depth image's points to the estimated surface, metres."""

    discretisation: Discretisation
    picture: Picture
    model: md.ReducedModel
    fit: Fit
    free: bool
    distance: Array | None

    def row(self) -> tuple[str, ...]:
        low, high = (value / 1e3 for value in self.fit.interval)
        return (
            self.discretisation.name,
            self.picture.name,
            "free" if self.free else "marker",
            f"{self.fit.shear / 1e3:.1f} kPa",
            f"{low:.1f} to {high:.1f} kPa",
            f"{self.fit.outline_rms:.2f} px",
            f"{np.degrees(self.fit.turn):.1f} deg",
            "" if self.distance is None else f"{1e3 * self.distance.mean():.2f} mm",
        )


def estimate(data: Path) -> list[Case]:
    """All estimates; the first is that from the depth image with the published elements."""
    cases = []
    for discretisation in (PUBLISHED, FINER, CONVERGED):
        bar = load_bar(data, mesh=discretisation.mesh)
        model = bar_model(OUTPUT, bar, discretisation)
        pictures = (depth_picture(bar), colour_picture(data, bar))
        turns = (False, True) if discretisation is CONVERGED else (False,)
        for picture, free in ((picture, free) for free in turns for picture in pictures):
            found = fit(model, picture, FREE_TURN if free else MARKER_STD)
            distance = None
            if picture.depth is not None:
                nodes = found.state.camera_from_object.apply(model.positions(found.state.parameters))
                points = picture.camera_from_object.apply(bar.points)
                distance = distances_to_surface(points, nodes, model.triangles)
            cases.append(Case(discretisation, picture, model, found, free, distance))
    return cases


def draw(case: Case) -> NDArray[np.uint8]:
    """The estimated bar, coloured by von Mises stress, over its picture, with the outline that was found."""
    picture, state = case.picture, case.fit.state
    nodes = state.camera_from_object.apply(case.model.positions(state.parameters))
    pixels = picture.camera.project(nodes)
    height, width = picture.image.shape[:2]
    corner = np.clip(np.median(pixels, axis=0).astype(int) - SHOWN // 2, 0, [width, height] - SHOWN)
    (left, top), (right, bottom) = corner, corner + SHOWN
    stress = case.model.von_mises(state.parameters, "solid") / 1e3
    drawn = draw_overlay(
        np.ascontiguousarray(picture.image[top:bottom, left:right]),
        pixels - corner,
        nodes[:, 2],
        case.model.triangles,
        stress,
        (0.0, float(np.percentile(stress, 99))),
        label="von Mises, kPa",
        caption=f"{case.discretisation.name}: {case.fit.shear / 1e3:.0f} kPa",
        alpha=0.5,
    )
    x, y = np.rint(picture.outline - corner).astype(int).T
    shown = (x >= 0) & (y >= 0) & (x < SHOWN[0]) & (y < SHOWN[1])
    drawn[y[shown], x[shown]] = 255
    return drawn


def write_page(cases: list[Case], picture: Path) -> list[tuple[str, ...]]:
    """Write the page with the published modulus beside ours; returns its table."""
    rows = [
        (PUBLISHED.name, "published", "marker", f"{PUBLISHED_SHEAR / 1e3:.1f} kPa", "", "", "", ""),
        *(case.row() for case in cases),
    ]
    notes = [
        "Elements that lock are too stiff, so that a softer silicone explains the same pictures: a modulus "
        "belongs to the elements it was identified with.",
        "The interval holds the errors of the outline, alike over stretches of it, and of the marker's pose. "
        "It does not hold those of the discretisation or of the clamp, which the rows show.",
    ]
    blocks = [
        Table(rows, HEADER),
        *map(Text, notes),
        reports.Picture.read(picture, "Estimated bars over their pictures."),
    ]
    page = OUTPUT / "estimate.html"
    write_report(page, "Stiffness of a hanging silicone bar from pictures", [Section("Shear modulus", blocks)])
    print(f"page {page}")
    return rows


def run(arguments: argparse.Namespace) -> None:
    OUTPUT.mkdir(exist_ok=True)
    cases = estimate(arguments.data)
    rigid = {(case.discretisation.name, case.picture.name): case for case in cases if not case.free}
    first, second, *_, converged, in_colour = rigid.values()
    picture = OUTPUT / "estimate.png"
    tiles = [draw(case) for case in (first, second, converged, in_colour)]
    cv2.imwrite(str(picture), np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))
    for line in Table(write_page(cases, picture), HEADER).text():
        print(line)
    low, high = (value / 1e3 for value in first.fit.interval)
    assert first.distance is not None
    print(
        f"shear_kPa={first.fit.shear / 1e3:.1f} interval_kPa={low:.1f}-{high:.1f} "
        f"published_kPa={PUBLISHED_SHEAR / 1e3:.1f} colour_kPa={second.fit.shear / 1e3:.1f} "
        f"converged_kPa={converged.fit.shear / 1e3:.1f} surface_mean_mm={1e3 * first.distance.mean():.2f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("diffcal_silicone"), help="the recordings' folder (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "models built so far are kept")


if __name__ == "__main__":
    sys.exit(main())
