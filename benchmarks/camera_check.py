"""The camera as `morph slam` checks and refines it, on rendered films with a known camera.

    python benchmarks/camera_check.py [--seeds N] [--refine]

Each film is mapped with the right camera and with wrong ones: focal length 10 % off, principal point 30 px off, lens
missing or with the wrong sign. A line for each tells in how many films the wrong term was named, in how many a right
one was accused, and in how many a term was called unobservable; with --refine also the largest error of the focal
length after `--refine-camera`, in percent. `errors_in_std` is the root mean square of the errors of the focal length
and the principal point in stated deviations, with the right camera. The last lines are of a rolling shutter (one frame
interval), of one plane and of a camera that hardly moves.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.rendered_room import Film, RoomFilm, hand_held, room, wall

from morph_dslam import Camera, map_scene
from morph_dslam.extend.slam import CameraEstimate, refine_camera, warm_up

Array = NDArray[np.float64]
PLAIN = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
LENS = replace(PLAIN, distortion=(-0.28, 0.07, 0.0, 0.0))
ROLLING = replace(PLAIN, readout_s=1.0 / 30.0)
#: Larger images that recorded ones are taken from.
WIDE = Camera(1000, 760, 525.0, 525.0, 499.5, 379.5)
N_FRAMES, BANDS = 100, 16
#: Name, true camera, given camera, the term that is wrong, scene and reach of the motion in metres.
Case = tuple[str, Camera, Camera, str, Callable, float]
CASES: list[Case] = [
    ("right", PLAIN, PLAIN, "", room, 0.5),
    ("right_lens", LENS, LENS, "", room, 0.5),
    ("focal_long", PLAIN, replace(PLAIN, fx=577.5, fy=577.5), "focal", room, 0.5),
    ("focal_short", PLAIN, replace(PLAIN, fx=472.5, fy=472.5), "focal", room, 0.5),
    ("centre", PLAIN, replace(PLAIN, cx=349.5), "centre", room, 0.5),
    ("lens_missing", LENS, PLAIN, "radial", room, 0.5),
    ("lens_wrong_sign", LENS, replace(LENS, distortion=(0.28, -0.07, 0.0, 0.0)), "radial", room, 0.5),
    ("rolling", ROLLING, PLAIN, "readout", room, 0.5),
    ("plane", PLAIN, PLAIN, "", wall, 0.5),
    ("plane_focal", PLAIN, replace(PLAIN, fx=577.5, fy=577.5), "focal", wall, 0.5),
    ("small_motion", PLAIN, PLAIN, "", room, 0.2),
    ("small_motion_focal", PLAIN, replace(PLAIN, fx=577.5, fy=577.5), "focal", room, 0.2),
]


def film(scene: Callable, seed: int, true: Camera, reach: float) -> Film:
    """Images of a hand-held camera with a lens, whose rows are read one after the other."""
    renderer, rng = RoomFilm(seed=seed, scene=scene, camera=WIDE), np.random.default_rng(seed)
    bands = BANDS if true.readout_s else 1
    # The path between frames: as many places in each frame interval as the image has bands.
    path = hand_held(bands * N_FRAMES, seed, reach)
    rows, columns = np.mgrid[: true.height, : true.width]
    recorded = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    sought = true.undistort_pixels(recorded) + np.array([WIDE.cx - true.cx, WIDE.cy - true.cy])
    maps = sought.astype(np.float32).reshape(true.height, true.width, 2)
    images = []
    for number in range(N_FRAMES):
        image = np.zeros((true.height, true.width))
        for band, part in enumerate(np.array_split(np.arange(true.height), bands)):
            seen = renderer.frame(path[bands * number + band], noise=0.0)
            image[part] = cv2.remap(seen, maps[part], None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        noisy = image + 2.0 * rng.standard_normal(image.shape)
        images.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return Film(images)


def departures(estimate: CameraEstimate, true: Camera) -> Array:
    """Errors (3,) of the focal length and the principal point in their deviations."""
    focal, centre = estimate.terms["focal"], estimate.terms["centre"]
    errors = np.subtract([*focal.estimated, *centre.estimated], [true.fx, true.cx, true.cy])
    return errors / [*focal.std, *centre.std]


def line(case: Case, seeds: int, refine: bool) -> str:
    """The figures of one case."""
    name, true, given, wrong, scene, reach = case
    counts: dict[str, int] = dict.fromkeys(("named", "accused", "unobservable", "no_map"), 0)
    errors, focal = list[Any](), list[float]()
    for seed in tqdm(range(seeds), desc=name, unit="film"):
        images = film(scene, seed, true, reach)
        estimate = map_scene(images, given).camera_estimate()
        if estimate is None:
            counts["no_map"] += 1
            continue
        named = {term for term, found in estimate.terms.items() if found.is_wrong and found.is_observable}
        counts["named"] += wrong in named
        counts["accused"] += bool(named - {wrong})
        counts["unobservable"] += any(not found.is_observable for found in estimate.terms.values())
        errors.append(departures(estimate, true))
        if refine:
            focal.append(abs(refine_camera(images, given).camera.fx / true.fx - 1.0))
    more = f" errors_in_std={np.sqrt(np.mean(np.square(errors))):.2f}" if errors and true == given else ""
    more += f" refined_focal_percent={100.0 * max(focal):.2f}" if focal else ""
    return f"{name}: n={seeds} " + " ".join(f"{key}={value}" for key, value in counts.items()) + more


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="films of each case")
    parser.add_argument("--cases", default=",".join(case[0] for case in CASES), help="which, separated by commas")
    parser.add_argument("--refine", action="store_true", help="refine the camera, too")
    arguments = parser.parse_args()
    warm_up()
    for case in CASES:
        if case[0] in arguments.cases.split(","):
            print(line(case, arguments.seeds, arguments.refine), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
