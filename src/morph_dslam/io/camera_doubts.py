"""What in a camera is hardly right, though one could be so: numbers of another image size, fits that went astray."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morph_dslam.camera import Camera

#: The principal point is in this middle part of the image, each way, unless the image was cut out of a larger one. That
#: of half the size is a quarter of the width from the edge.
MIDDLE = 0.48
#: Pixels are square up to this factor.
SQUARE = 1.25
#: A lens that images nothing in more than this part of the picture was fitted to too little.
MOST_FOLDED = 0.05


def camera_doubts(camera: Camera) -> Iterator[str]:
    """What to tell of a camera that is hardly right, in words."""
    off = np.abs([(camera.cx + 0.5) / camera.width - 0.5, (camera.cy + 0.5) / camera.height - 0.5])
    if off.max() > 0.5 * MIDDLE:
        yield (
            f"the camera's principal point ({camera.cx:.0f}, {camera.cy:.0f}) px is far from the middle of images of "
            f"{camera.width}x{camera.height}: if it was calibrated at another size, scale fx, fy, cx and cy"
        )
    if not 1.0 / SQUARE < camera.fx / camera.fy < SQUARE:
        yield (
            f"the camera's fx and fy, {camera.fx:.0f} and {camera.fy:.0f} px, differ by more than a quarter, and "
            "pixels are nearly always square: correct the one that is wrong"
        )
    columns, rows = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 13))
    seen = camera.undistort_pixels(np.column_stack([columns.ravel(), rows.ravel()]))
    folded = 1.0 - float(np.isfinite(seen).all(axis=1).mean())
    # A fisheye may see what no undistorted image can show.
    if camera.lens_model != "fisheye" and folded > MOST_FOLDED:
        yield (
            f"the camera's lens distortion folds the image: nothing could be seen in {folded:.0%} of it; calibrate "
            "again, with the board near the edges of the image too"
        )
