"""Frame sources: order, numbering, ranges, and what is said of bad input."""

import cv2
import numpy as np
import pytest

from morph_dslam.errors import SourceError
from morph_dslam.sources import open_source


def grey(value, size=(32, 48)):
    return np.full((*size, 3), value, dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    for number in (2, 10, 1, 3):
        cv2.imwrite(str(tmp_path / f"shot-{number}.png"), grey(number * 10))
    (tmp_path / "notes.txt").write_text("not an image")
    return tmp_path


def make_video(path, fourcc, n_frames=12):
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 25.0, (96, 64))
    for position in range(n_frames):
        writer.write(np.roll(noise, position, axis=1))
    writer.release()
    return path


def test_folder_is_ordered_by_number_not_by_name(folder):
    source = open_source(folder)
    frames = list(source)
    assert [frame.index for frame in frames] == [1, 2, 3, 10]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [10, 20, 30, 100]
    assert len(source) == 4
    assert frames[-1].timestamp == pytest.approx(10 / source.fps)


def test_folder_range_is_inclusive_and_iterates_twice(folder):
    source = open_source(folder, first=2, last=3)
    assert [frame.index for frame in source] == [2, 3]
    assert [frame.index for frame in source] == [2, 3]


def test_grey_images_become_three_channels(tmp_path):
    cv2.imwrite(str(tmp_path / "000.jpg"), np.full((8, 8), 77, dtype=np.uint8))
    (frame,) = open_source(tmp_path)
    assert frame.image.shape == (8, 8, 3)


def test_video_frames_in_order(tmp_path):
    source = open_source(make_video(tmp_path / "clip.avi", "MJPG"), first=2, last=9)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(2, 10))
    assert source.fps == pytest.approx(25.0)
    assert frames[0].timestamp == pytest.approx(2 / 25.0)
    # Frame k is the noise moved k pixels to the right.
    moved = np.roll(frames[0].image, 7, axis=1).astype(float)
    assert np.abs(moved - frames[7].image).mean() < np.abs(frames[0].image.astype(float) - frames[7].image).mean()


def test_video_timestamps_are_the_containers(tmp_path, monkeypatch):
    path, times = make_video(tmp_path / "clip.avi", "MJPG", n_frames=4), iter([0.0, 33.0, 100.0, 0.0])
    original = cv2.VideoCapture

    class Varying:
        """A video filmed at a varying rate, whose last frame has lost its time."""

        def __init__(self, name):
            self.capture = original(name)

        def __getattr__(self, name):
            return getattr(self.capture, name)

        def get(self, what):
            return next(times) if what == cv2.CAP_PROP_POS_MSEC else self.capture.get(what)

    monkeypatch.setattr(cv2, "VideoCapture", Varying)
    assert [frame.timestamp for frame in open_source(path)] == pytest.approx([0.0, 0.033, 0.1, 3 / 25.0])


def test_truncated_video_gives_its_frames_and_then_the_break(tmp_path):
    path = make_video(tmp_path / "clip.avi", "MJPG", n_frames=20)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data))])
    frames = []
    with pytest.raises(SourceError, match=r"clip\.avi breaks off at frame \d+") as caught:
        frames.extend(frame.index for frame in open_source(path))
    assert 5 <= len(frames) <= 14
    assert frames == list(range(len(frames)))
    assert f"frame {len(frames)}," in str(caught.value)


def test_video_without_its_index_cannot_be_opened(tmp_path):
    path = make_video(tmp_path / "clip.mp4", "mp4v")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"clip\.mp4 cannot be opened as a video"):
        open_source(path)


def test_missing_path(tmp_path):
    with pytest.raises(SourceError, match=r"no folder of images and no video at .*nowhere"):
        open_source(tmp_path / "nowhere")


def test_empty_folder_and_file_that_is_no_video(tmp_path):
    with pytest.raises(SourceError, match="holds no images"):
        open_source(tmp_path)
    (tmp_path / "text.mp4").write_text("hello")
    with pytest.raises(SourceError, match=r"text\.mp4 cannot be opened"):
        open_source(tmp_path / "text.mp4")


@pytest.mark.parametrize(("first", "last"), [(0, 3), (1, 11), (1, 5)])
def test_range_that_the_folder_does_not_reach(folder, first, last):
    with pytest.raises(SourceError, match=f"frame ({first}|{last}) "):
        open_source(folder, first, last)


def test_range_turned_round(folder):
    with pytest.raises(SourceError, match="before the first"):
        open_source(folder, 3, 2)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_image_cut_short_is_named_after_the_frames_before_it(tmp_path, suffix):
    rng = np.random.default_rng(0)
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number:03}.{suffix}"), rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    damaged = tmp_path / f"002.{suffix}"
    damaged.write_bytes(damaged.read_bytes()[:2000])
    frames = iter(open_source(tmp_path))
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(SourceError, match=rf"frame 2: .*002\.{suffix}"):
        next(frames)


def test_image_that_is_not_one(folder):
    (folder / "shot-3.png").write_bytes(b"")
    with pytest.raises(SourceError, match=r"frame 3: .*shot-3\.png"):
        list(open_source(folder))


def test_change_of_size(folder):
    cv2.imwrite(str(folder / "shot-3.png"), grey(30, size=(16, 16)))
    with pytest.raises(SourceError, match=r"frame 3: .* is 16x16 pixels, the frames before it are 48x32"):
        list(open_source(folder))


def test_names_that_give_no_order(tmp_path):
    cv2.imwrite(str(tmp_path / "a1.png"), grey(1))
    cv2.imwrite(str(tmp_path / "b1.png"), grey(1))
    with pytest.raises(SourceError, match="two images for frame 1"):
        open_source(tmp_path)
    (tmp_path / "b1.png").rename(tmp_path / "b.png")
    with pytest.raises(SourceError, match="no number in its name"):
        open_source(tmp_path)
