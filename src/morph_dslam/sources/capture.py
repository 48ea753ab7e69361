"""Opening videos and webcams by OpenCV, without what it and FFmpeg print: what is wrong our messages say."""

from __future__ import annotations

import os
from typing import Any

import cv2

#: What OpenCV hands on to FFmpeg as its log level: AV_LOG_QUIET.
_QUIET = "-8"
#: OpenCV's own level at which it prints nothing.
_SILENT = 0


def open_capture(source: str | int) -> cv2.VideoCapture:
    """A video file, or a webcam by its number; whether it could be opened, its ``isOpened()`` says."""
    # It is read once, when the first video is opened.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _QUIET)
    # Until 4.12 these functions were OpenCV's own, since then they are in a module.
    log: Any = getattr(cv2.utils, "logging", cv2)
    before = log.getLogLevel()
    log.setLogLevel(_SILENT)
    try:
        return cv2.VideoCapture(source)
    finally:
        log.setLogLevel(before)
