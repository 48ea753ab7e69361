"""Place the demo's sheet without landmarks, by the picture of its print and by a guess; after `make demo`.

Writes `demo/aids/picture.toml` and `guess.toml`, tracks the first second from each, and prints how far off
that is.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.registration import InitializerFiles
from morph_dslam.extend.rendering import load_scene_file, print_texture, sheet_bounds
from morph_dslam.extend.reports import result_line

HERE = Path(__file__).resolve().parent
DEMO = HERE.parents[1] / "demo"
FOLDER = DEMO / "aids"
PIXELS_PER_METRE = 4000.0


def write_picture() -> None:
    """The print as it lies on the sheet, and where."""
    scene = load_scene_file(HERE / "scene.toml")
    low, high = sheet_bounds(md.load_model(DEMO / "sheet.morph"))
    texture = print_texture(scene.surface, HERE, high - low, PIXELS_PER_METRE)
    cv2.imwrite(str(FOLDER / "print.png"), texture)
    left, right, bottom, top = 1e3 * low[0], 1e3 * high[0], 1e3 * low[1], 1e3 * high[1]
    (FOLDER / "picture.toml").write_text(
        'image = "print.png"\n[rectangle]\n'
        f"corner_mm = [{left}, {top}, 0]\nright_mm = [{right - left}, 0, 0]\n"
        f"down_mm = [0, {bottom - top}, 0]\n"
    )


def write_guess() -> None:
    """About where the scene file puts the sheet at first."""
    (FOLDER / "guess.toml").write_text(
        "[pose]\nposition_mm = [-25, 3, 405]\nrotation_deg = [182, 1, 2]\n[parameters]\nbulge = 6\nbend = 0.9\n"
    )


def run(_: argparse.Namespace) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_picture()
    write_guess()
    sequence = DEMO / "sequence"
    for aid in ("picture", "guess"):
        folder = FOLDER / aid
        md.track(
            md.TrackOptions(
                frames=sequence / "frames",
                model=DEMO / "sheet.morph",
                camera=sequence / "camera.yaml",
                initializer=InitializerFiles(**{aid: FOLDER / f"{aid}.toml"}),
                output=folder,
                last=29,
                video=False,
                overwrite=True,
            )
        )
        print(result_line(md.evaluate(folder, sequence / "truth.npz", bind_frame=0)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    return run_and_report_errors(run, parser.parse_args(), "the runs so far are kept")


if __name__ == "__main__":
    sys.exit(main())
