"""Opening videos and webcams by OpenCV, without what it and FFmpeg print: what is wrong our messages say."""

from __future__ import annotations

import os

import cv2

#: What OpenCV hands on to FFmpeg as its log level: AV_LOG_QUIET.
_QUIET = "-8"


def open_capture(source: str | int) -> cv2.VideoCapture:
    """A video file, or a webcam by its number; whether it could be opened, its ``isOpened()`` says."""
    # It is read once, when the first video is opened.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _QUIET)
    before = cv2.utils.logging.getLogLevel()  # type: ignore[attr-defined]
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # type: ignore[attr-defined]
    try:
        return cv2.VideoCapture(source)
    finally:
        cv2.utils.logging.setLogLevel(before)  # type: ignore[attr-defined]
