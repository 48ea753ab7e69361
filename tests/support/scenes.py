"""Scene files for tests, on the analytic bent sheet."""

import cv2
import numpy as np

from morph_dslam import TrackOptions, track
from morph_dslam.model import save_model
from morph_dslam.render.simulation import simulate
from tests.support.bent_sheet import bent_sheet_model

CAMERA = "camera = { width = 320, height = 240, fx = 260.0, fy = 262.0, cx = 158.0, cy = 121.0 }\n"
MOTION = """
[[parameters]]
frame = 0
arch = 5.0
[[parameters]]
frame = 4
arch = 45.0
skew = 0.3
twist = 12.0

[[pose]]
frame = 0
position_mm = [0, 0, 620]
[[pose]]
frame = 4
position_mm = [15, -10, 600]
rotation_deg = [205, 14, 8]
"""


def write_texture(folder, cells=(60, 84), size=(420, 300)):
    """A texture file `print.png` of smooth coloured noise; returns its name."""
    noise = np.random.default_rng(3).integers(0, 256, (*cells, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "print.png"), cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC))
    return "print.png"


def write_scene(folder, top="", tail=MOTION, camera=CAMERA, texture=None):
    """Write `sheet.morph`, a texture and `scene.toml` in ``folder``; returns the scene's path.

    ``top`` holds more keys of the file's root, ``tail`` its key frames and further sections.
    """
    if not (folder / "sheet.morph").exists():
        save_model(folder / "sheet.morph", bent_sheet_model(29, 21))
    texture = texture or write_texture(folder)
    frames = "" if "frames" in top else "frames = 5\n"
    head = f'model = "sheet.morph"\nimage_format = "png"\n{frames}{camera}{top}\n'
    path = folder / "scene.toml"
    path.write_text(f'{head}[surface]\ntexture = "{texture}"\n{tail}')
    return path


def film_and_track(scene, model, **options):
    """Simulate a scene file and track the film; the summary, and the folders of the film and of the run."""
    film, run = scene.with_name(f"{scene.stem}-film"), scene.with_name(f"{scene.stem}-run")
    simulate(scene, film, progress=False)
    files = {"camera": film / "camera.yaml", "landmarks": film / "landmarks.csv"}
    summary = track(TrackOptions(frames=film / "frames", model=model, output=run, video=False, **files, **options))
    return summary, film, run
