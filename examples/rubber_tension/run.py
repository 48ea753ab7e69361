"""Pull real rubber until it breaks, and compare what is tracked with measurements that share no code with it.

The recordings (slslesarenko/jupyterWSM, 2019) are not part of the project. Four printed specimens, 48 x 24 x 2.5 mm,
are stretched by up to 46 % before a camera with a long lens whose intrinsics nobody knows: three with speckles, one of
them with 43 stiff discs, and a black one without any texture. Camera and right clamp stand still, so the pose is one
over the sequence.

What the models rest on: the drawings; the rubber's two constants, fitted to the force curves of both notched specimens
(each run prints the factor that is left); the discs' diameter, 1.8 mm, where their brightness in the first picture
reaches that of the rubber (jetted materials mix at their boundary: 1.5 mm are drawn).
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from baselines import polynomial_errors
from measure import Tracks, disc_tracks, pictures, speckle_tracks
from numpy.typing import NDArray
from report import Compared, draw_errors, draw_points, write_page
from specimen import Shape, write_mesh

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.reports import evaluate_force, evaluate_pixels, force_line, load_tracks, pixel_error, pixel_line
from support import data_folder, keep

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
#: Pixels of a millimetre at rest, and where the specimen's middle is, about: to find the discs, and for the baselines.
PX_PER_MM, MIDDLE = 30.8, (1126.5, 640.0)
#: Frames through which the stroke is a straight line, from when the clamp moves evenly.
EVEN_FROM = 5
#: Radius that is painted over a disc, pixels, softly, so that the paint has no edge to follow.
PAINTED = 34
#: Columns a frame by which the specimen's middle moves left while the clamp moves by twice that.
MIDDLE_SPEED = 2.57
#: Grey level of the paint over a disc and over the hidden half.
DISC_GREY, HALF_GREY = 75, 128


@dataclass(frozen=True)
class Specimen:
    """One recording.

    Attributes
    ----------
    notch : length of a notch in the drawing, mm.
    last : frame to end with.
    reference_frame : the frame of its landmarks.
    stroke : largest stroke of the model, mm.
    discs : whether it has the 43 discs.
    outline : whether its outline is all there is.
    at_rest : whether it is undeformed in the reference frame; the notched ones take up slack until frame 6.
    force : its column in force_stroke.csv; empty if its force was not measured.
    """

    notch: float
    last: int
    reference_frame: int
    stroke: float
    discs: bool = False
    outline: bool = False
    at_rest: bool = False
    force: str = ""


SPECIMENS = {
    "manyincs": Specimen(6.0, 105, 0, 21.0, discs=True, at_rest=True),
    "notch_7.2mm": Specimen(7.2, 102, 6, 18.0, force="notch_7.2mm_N"),
    "notch_3.6mm": Specimen(3.6, 130, 6, 23.0, force="notch_3.6mm_N"),
    "black_notch_3.6mm": Specimen(3.6, 126, 3, 23.0, outline=True, force="black_notch_3.6mm_N"),
}
#: The frame that the picture of all runs shows.
SHOWN_FRAME = 80
#: Frames up to which the notched specimens are compared: then a crack grows.
SOUND_UNTIL = {"notch_7.2mm": 80, "notch_3.6mm": 100}


def disc_positions(data: Path) -> Array:
    """Middles of the discs (43, 2), mm, x along the load and y downwards in the pictures; the file is turned."""
    listed = np.loadtxt(data / "inclusions_mm.txt")
    return np.column_stack([listed[:, 1], -listed[:, 0]])


def study(mesh: Path, specimen: Specimen) -> dict[str, Any]:
    """The strip between a still clamp and one that moves."""
    materials = {"rubber": {"law": "mooney_rivlin", "c10": "0.068 MPa", "c01": "0.045 MPa", "bulk": "22.6 MPa"}}
    if specimen.discs:
        materials["rubber"]["on"] = "rubber"
        # Stiff beside the rubber; more would only spoil the equations.
        materials["discs"] = {"law": "neo_hookean", "on": "discs", "young": "300 MPa", "poisson": "0.4"}
    return {
        "name": mesh.stem,
        "mesh": {"file": mesh.name, "unit": "mm"},
        "materials": materials,
        "supports": [
            {"kind": "fixed", "on": "right"},
            {"kind": "displacement", "on": "left", "x": "-1 * stroke", "y": "0 mm", "z": "0 mm"},
        ],
        "parameters": {
            "stroke": {"range": ["-0.5 mm", f"{specimen.stroke} mm"], "description": "way of the left clamp"}
        },
        "solver": {"formulation": "mixed"},
        "sampling": {"scheme": "even", "training": 15, "held_out": 4},
        "reduction": {"method": "pod", "tolerance": 1e-4},
    }


def build(name: str, specimen: Specimen, data: Path) -> Path:
    """The specimen's model, built once."""
    mesh, model = OUTPUT / f"{name}.inp", OUTPUT / f"{name}.morph"
    OUTPUT.mkdir(exist_ok=True)
    discs = disc_positions(data) if specimen.discs else np.zeros((0, 2))
    write_mesh(mesh, Shape(specimen.notch, discs))
    content, recipe = study(mesh, specimen), OUTPUT / f"{name}.json"
    recipe.write_text(json.dumps(content, indent=1))
    keep(model, [mesh, recipe], lambda: md.build(md.make_study(content, OUTPUT), model))
    return model


def paint(video: Path, discs: Array, folder: Path, hide_left: bool, last: int) -> None:
    """Write the pictures with the discs painted over, and with the left half if that is asked for."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures(video, last)):
        mask = np.zeros(picture.shape, dtype=np.float32)
        for u, v in discs[number][np.isfinite(discs[number, :, 0])]:
            cv2.circle(mask, (round(u), round(v)), PAINTED, 1.0, -1)
        mask = cv2.GaussianBlur(mask, (0, 0), 3.0)
        painted = (1.0 - mask) * picture + mask * DISC_GREY
        if hide_left:
            painted[:, : int(MIDDLE[0] - MIDDLE_SPEED * max(number - 3, 0))] = HALF_GREY
        cv2.imwrite(str(folder / f"{number:06}.png"), painted.astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])


def track(name: str, specimen: Specimen, frames: Path, model: Path, output: Path) -> md.Run:
    """Track a recording, camera and right clamp standing still."""
    md.track(
        md.TrackOptions(
            frames=frames,
            model=model,
            camera=HERE / "camera.yaml",
            landmarks=HERE / "landmarks" / f"{name}.csv",
            output=output,
            first=0 if not specimen.outline else specimen.reference_frame,
            last=specimen.last,
            reference_frame=specimen.reference_frame,
            at_rest=specimen.at_rest,
            refine_camera=("radial",),
            tracker=md.TrackerOptions(
                pose="still", use_outline=specimen.outline, use_texture=not specimen.outline, new_views=False
            ),
            overwrite=True,
        )
    )
    return md.load_run(output)


def stroke_line(run: md.Run, until: int) -> dict[str, float]:
    """The stroke as a straight line through the frames in which the clamp moves evenly, mm."""
    used = run.tracked & (run.frames >= EVEN_FROM) & (run.frames <= until)
    frames, stroke = run.frames[used], 1e3 * run.parameters[used, 0]
    line = np.polyfit(frames, stroke, 1)
    return {
        "stroke_mm_per_frame": float(line[0]),
        "stroke_scatter_mm": float(np.std(stroke - np.polyval(line, frames))),
    }


def beside_discs(run: md.Run, truth: Tracks) -> tuple[float, float]:
    """How far the clamp itself is off an even motion, by the discs, and the tracked stroke from theirs, std, mm.

    The discs' mean place along the load is taken for the stroke up to a factor and an offset.
    """
    used = run.tracked & (run.frames >= EVEN_FROM)
    frames, stroke = run.frames[used], 1e3 * run.parameters[used, 0]
    discs = truth.pixels[frames][:, np.isfinite(truth.pixels).all(axis=(0, 2)), 0].mean(axis=1)
    lines = [np.polyfit(frames, motion, 1) for motion in (stroke, discs)]
    tracked, measured = (m - np.polyval(line, frames) for m, line in zip((stroke, discs), lines, strict=True))
    measured *= lines[0][0] / lines[1][0]
    return float(np.std(measured)), float(np.std(tracked - measured))


def stated_deviation(folder: Path, until: int) -> float:
    """Median stated standard deviation of the stroke, mm."""
    with (folder / "frames.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "tracked"]
    stated = [float(row["stroke_std_mm"]) for row in rows if EVEN_FROM <= int(row["frame"]) <= until]
    return float(np.median(stated))


def crack_frame(folder: Path) -> int | None:
    """The frame from which on a run names a crack; None if it names none."""
    notices = json.loads((folder / "summary.json").read_text())["notices"]
    return next((notice["first"] for notice in notices if notice["kind"] == "surface_jumps"), None)


@dataclass
class Comparison:
    """What a specimen's runs gave.

    Attributes
    ----------
    figures : by name.
    runs : each beside what was measured.
    pictures : by caption.
    without : errors of polynomials, mm, by name.
    tracked : frames tracked of all.
    crack : frame from which on a crack is named; None if none is.
    """

    figures: dict[str, float]
    runs: list[Compared]
    pictures: dict[str, Path]
    without: dict[str, float]
    tracked: tuple[int, int] = (0, 0)
    crack: int | None = None

    def add(self, run: md.Run, folder: Path, tracks: Tracks, what: str, specimen: Specimen) -> dict[str, Any]:
        """Compare a run, in its folder, with tracks, bound in the reference frame; returns the figures."""
        path = OUTPUT / f"{folder.name}_{what.replace(' ', '_')}.csv"
        tracks.write(path)
        figures = evaluate_pixels(folder, path, specimen.reference_frame)
        print(f"{what}: {pixel_line(figures)}")
        points = load_tracks(path)
        self.runs.append(Compared(what, run, pixel_error(run, points, specimen.reference_frame), points))
        self.pictures[what] = path.with_suffix(".png")
        draw_points(self.pictures[what], self.runs[-1:])
        return figures

    def take(self, run: md.Run, folder: Path, until: int, figures: dict[str, Any]) -> None:
        """Keep what a run says of the stroke up to a frame, and of points where they were compared."""
        self.figures |= {key: figures[key] for key in ("mean_mm", "p95_mm") if key in figures}
        self.figures |= stroke_line(run, until) | {"stroke_std_mm": stated_deviation(folder, until)}
        self.tracked, self.crack = (int(run.tracked.sum()), len(run.frames)), crack_frame(folder)


def with_discs(name: str, specimen: Specimen, data: Path, model: Path) -> Comparison:
    """The specimen with discs: all of it seen, and its left half hidden."""
    video, drawn = data / f"{name}.mp4", disc_positions(data)
    truth = disc_tracks(video, np.array(MIDDLE) + PX_PER_MM * drawn, specimen.last)
    at_rest = truth.pixels[:3]
    print(f"discs: repeated to {np.std(at_rest - at_rest.mean(axis=0)) / PX_PER_MM:.4f} mm in three frames at rest")
    half = np.zeros((1216, 1936), dtype=bool)
    half[:, : round(MIDDLE[0])] = True
    seen, hidden = speckle_tracks(video, specimen.last, half), Tracks(truth.pixels[:, drawn[:, 0] < 0.0])
    found = Comparison({}, [], {}, polynomial_errors(seen.pixels, hidden.pixels, PX_PER_MM))
    print("hidden half without physics: " + ", ".join(f"{n} {mm:.2f} mm" for n, mm in found.without.items()))
    for part, what in (("all", "all seen"), ("half", "left half hidden")):
        frames, folder, hide = OUTPUT / f"{name}_{part}", OUTPUT / f"run_{name}_{part}", part == "half"
        paint(video, truth.pixels, frames, hide, specimen.last)
        run = track(name, specimen, frames, model, folder)
        figures = found.add(run, folder, hidden if hide else truth, what, specimen)
        if hide:
            found.figures["hidden_mm"] = figures["mean_mm"]
        else:
            found.take(run, folder, specimen.last, figures)
            clamp, ours = beside_discs(run, truth)
            print(
                f"stroke: the clamp's, by the discs, scatters by {clamp:.4f} mm, the tracked one about it by {ours:.4f}"
            )
            if found.crack is not None:
                sound = stroke_line(run, found.crack - 1)["stroke_scatter_mm"]
                print(f"stroke before frame {found.crack}, from which on a crack is named: scatters by {sound:.4f} mm")
    return found


def without_discs(name: str, specimen: Specimen, data: Path, model: Path) -> Comparison:
    """A specimen without discs: its speckles, and its force."""
    video, folder = data / f"{name}.mp4", OUTPUT / f"run_{name}"
    run = track(name, specimen, video, model, folder)
    until, found, figures = SOUND_UNTIL.get(name, specimen.last), Comparison({}, [], {}, {}), {}
    if not specimen.outline:
        figures = found.add(run, folder, speckle_tracks(video, until), "speckles", specimen)
    found.take(run, folder, until, figures)
    force = evaluate_force(folder, data / "force_stroke.csv", specimen.force)
    print(force_line(force))
    found.pictures["force on the clamp"] = folder / "force_evaluation.png"
    return found


def run(arguments: argparse.Namespace) -> None:
    specimen, data = SPECIMENS[arguments.specimen], arguments.data
    video = data / f"{arguments.specimen}.mp4"
    if not video.is_file():
        raise md.MorphError(f"there is no recording {video}: give the folder that holds it with --data")
    model = build(arguments.specimen, specimen, data)
    found = (with_discs if specimen.discs else without_discs)(arguments.specimen, specimen, data, model)
    if found.runs:
        found.pictures["mean distance in each frame"] = OUTPUT / f"{arguments.specimen}_errors.png"
        draw_errors(found.pictures["mean distance in each frame"], found.runs, found.without)
        draw_points(OUTPUT / f"{arguments.specimen}.png", found.runs, SHOWN_FRAME)
    page = OUTPUT / f"{arguments.specimen}.html"
    write_page(page, f"Rubber specimen {arguments.specimen}", found.figures, found.pictures, found.without)
    print(f"report  {page}")
    order = ("mean_mm", "p95_mm", "hidden_mm", "stroke_mm_per_frame", "stroke_scatter_mm", "stroke_std_mm")
    line = " ".join(f"{key}={found.figures[key]:.4f}" for key in order if key in found.figures)
    crack = "none" if found.crack is None else found.crack
    print(f"{line} crack_frame={crack} tracked={found.tracked[0]}/{found.tracked[1]}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--specimen", choices=sorted(SPECIMENS), default="manyincs", help="which one (%(default)s)")
    parser.add_argument(
        "--data", type=Path, default=data_folder("rubber_tension"), help="folder of the recordings (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "what was built and tracked so far is kept")


if __name__ == "__main__":
    sys.exit(main())
