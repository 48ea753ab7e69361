"""Written videos read back, also after an interruption."""

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.io.video import VideoWriter
from morph_dslam.sources import open_source


def frame(position):
    image = np.full((96, 128, 3), 40, dtype=np.uint8)
    cv2.circle(image, (20 + 8 * position, 48), 10, (30, 200, 230), -1)
    return image


def write(path, n_frames, error=None):
    with VideoWriter(path, 25.0, (128, 96)) as writer:
        for position in range(n_frames):
            writer.write(frame(position))
        if error:
            raise error


def test_frames_read_back(tmp_path):
    write(tmp_path / "out.mp4", 10)
    source = open_source(tmp_path / "out.mp4")
    frames = list(source)
    assert len(frames) == len(source) == 10
    assert source.fps == pytest.approx(25.0)
    for position, read in enumerate(frames):
        assert np.abs(read.image.astype(float) - frame(position)).mean() < 4.0
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]


def test_interrupted_video_plays_what_was_written(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out.mp4", 4, KeyboardInterrupt())
    assert len(list(open_source(tmp_path / "out.mp4"))) == 4


def test_no_frames_no_file_and_the_older_video_stays(tmp_path):
    write(tmp_path / "out.mp4", 3)
    write(tmp_path / "out.mp4", 0)
    assert len(list(open_source(tmp_path / "out.mp4"))) == 3


def test_missing_folder(tmp_path):
    with pytest.raises(SourceError, match="there is no folder"):
        write(tmp_path / "missing" / "out.mp4", 1)


def test_frame_of_another_size_is_refused(tmp_path):
    with VideoWriter(tmp_path / "out.mp4", 25.0, (128, 96)) as writer, pytest.raises(ValueError, match="128x96"):
        writer.write(np.zeros((48, 64, 3), dtype=np.uint8))
