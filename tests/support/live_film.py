"""A film for the fake camera of a browser, whose frames say in a corner which they are."""

from __future__ import annotations

import cv2
import numpy as np

#: Bits of a number, and the pixels of each one's block.
BITS, BLOCK = 9, 8


def numbered(image, number):
    """The image (h, w, 3) with its number in the upper left corner: black and white blocks, the lowest bit first."""
    marked = image.copy()
    for bit in range(BITS):
        marked[:BLOCK, bit * BLOCK : (bit + 1) * BLOCK] = 255 * (number >> bit & 1)
    return marked


def number_in(image):
    """The number in the corner of an image."""
    blocks = image[2 : BLOCK - 2, : BITS * BLOCK].mean(axis=2).reshape(-1, BITS, BLOCK)[..., 2:-2].mean(axis=(0, 2))
    return int((blocks > 128) @ (1 << np.arange(BITS)))


def write_film(path, images, fps=30):
    """Write images (h, w, 3) forwards and backwards as a .y4m file, which a browser's fake camera plays on end."""
    height, width = images[0].shape[:2]
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{width} H{height} F{fps}:1 Ip A1:1 C420\n".encode())
        for k in (*range(len(images)), *range(len(images) - 2, 0, -1)):
            file.write(b"FRAME\n")
            file.write(cv2.cvtColor(numbered(images[k], k), cv2.COLOR_BGR2YUV_I420).tobytes())


#: Options of a browser that draws without a graphics card; one in software would take most of the time.
NO_GPU = "--disable-gpu"


def fake_camera(film):
    """Options of a browser whose camera is a film, and which asks nobody."""
    return (
        NO_GPU, "--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream", "--ignore-certificate-errors",
        f"--use-file-for-fake-video-capture={film}",
    )  # fmt: skip
