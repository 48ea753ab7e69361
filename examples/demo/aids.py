"""Place the demo's sheet without landmarks, by the picture of its print and by a guess; after `make demo`.

Writes `demo/aids/picture.toml` and `guess.toml`, tracks the first second from each, and prints how far off
that is.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from morph_dslam.cli.app import main as morph
from morph_dslam.model import load_model
from morph_dslam.render.scene_file import load_scene_file
from morph_dslam.render.scene_renderer import print_texture
from morph_dslam.render.texture import sheet_bounds

HERE = Path(__file__).resolve().parent
DEMO = HERE.parents[1] / "demo"
FOLDER = DEMO / "aids"
PIXELS_PER_METRE = 4000.0


def write_picture() -> None:
    """The print as it lies on the sheet, and where."""
    scene = load_scene_file(HERE / "scene.toml")
    low, high = sheet_bounds(load_model(DEMO / "sheet.morph"))
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


def main() -> int:
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_picture()
    write_guess()
    sequence = DEMO / "sequence"
    for aid in ("picture", "guess"):
        run = FOLDER / aid
        files = ["--model", str(DEMO / "sheet.morph"), "--camera", str(sequence / "camera.yaml")]
        place = [f"--{aid}", str(FOLDER / f"{aid}.toml"), "--range", "0-29", "--no-video", "--overwrite"]
        status = morph(["track", str(sequence / "frames"), *files, *place, "-o", str(run)])
        if status:
            return status
        morph(["evaluate", str(run), "--points", str(sequence / "truth.npz"), "--bind-frame", "0"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
