"""Frame sources: order, numbering, ranges, layouts of benchmarks, written videos, and registered kinds."""

import json
import re
import struct
import zlib
from dataclasses import replace
from datetime import datetime, timedelta
from types import SimpleNamespace
from zlib import crc32

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from morph_dslam import sources
from morph_dslam.camera import Camera
from morph_dslam.errors import EvaluationError, SourceError, TrackingError
from morph_dslam.evaluation.depth import read_depths
from morph_dslam.extend import register_source
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.video import VideoWriter
from morph_dslam.slam.run import run_slam
from morph_dslam.sources import Frame, open_live, open_source, open_stream
from morph_dslam.sources.frames import check_range, notes_of_source, read_image
from morph_dslam.tracking.combinations import check_depth
from morph_dslam.tracking.synchronized import SynchronizedFrames
from tests.support.full_disk import largest_file
from tests.support.real_data import ROOT, real_data


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


def test_images_are_known_by_their_content(tmp_path):
    """A photograph that was given another ending, and pictures without any beside something else."""
    misnamed, nameless = tmp_path / "misnamed", tmp_path / "nameless"
    for folder in (misnamed, nameless):
        folder.mkdir()
        for number in range(3):
            cv2.imwrite(str(folder / f"{number}.jpg"), np.full((8, 8), 70 + number, dtype=np.uint8))
            (folder / f"{number}.jpg").rename(folder / (f"{number}.png" if folder is misnamed else f"shot {number}"))
        (folder / "notes.txt").write_text("three pictures\n")
        assert [int(frame.image[4, 4, 0]) for frame in open_source(folder)] == [70, 71, 72]
    cut = misnamed / "2.png"
    cut.write_bytes(cut.read_bytes()[:-2])
    with pytest.raises(SourceError, match=r"frame 2: .*2\.png is cut short"):
        list(open_source(misnamed))


def test_an_image_of_an_absurd_size_is_refused(folder):
    """As a damaged head says, for which OpenCV raises an error of its own."""
    path = folder / "shot-2.png"
    content = path.read_bytes()
    head = b"IHDR" + struct.pack(">II", 60000, 60000) + content[24:29]
    path.write_bytes(content[:12] + head + struct.pack(">I", crc32(head)) + content[33:])
    with pytest.raises(SourceError, match=r"frame 2: .*shot-2\.png cannot be decoded as an image"):
        list(open_source(folder))


@pytest.mark.parametrize("width", [48, 32])
@pytest.mark.parametrize(
    ("orientation", "turn", "said"),
    [(3, cv2.ROTATE_180, 2), (6, cv2.ROTATE_90_CLOCKWISE, 1), (8, cv2.ROTATE_90_COUNTERCLOCKWISE, 1)],
)
def test_images_are_turned_as_other_programs_show_them(tmp_path, orientation, turn, said, width):
    """Upside down the principal point is mirrored; either way the rows are not the camera's. One is square."""
    picture = np.full((32, width, 3), 40, dtype=np.uint8)
    picture[:16, : width // 2] = 220
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(picture).save(tmp_path / "0.jpg", quality=95, exif=exif)
    source = open_source(tmp_path)
    (frame,) = source
    assert np.abs(frame.image.astype(int) - cv2.rotate(picture, turn)).mean() < 5
    assert [len(notes_of_source(source, readout)) for readout in (0.0, 0.03)] == [said - 1, said + 1]
    Image.fromarray(picture).save(tmp_path / "0.jpg")
    assert notes_of_source(open_source(tmp_path)) == ()


@pytest.mark.parametrize("ending", ["png", "webp"])
def test_a_narrow_strip_that_is_upside_down_is_named(tmp_path, ending):
    """OpenCV refuses to read what a smaller size leaves no pixel of."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    picture = np.repeat(np.linspace(0, 250, 40).astype(np.uint8), 5).reshape(40, 5)
    Image.fromarray(picture).save(tmp_path / f"0.{ending}", exif=exif)
    shown = cv2.imread(str(tmp_path / f"0.{ending}"))[0, 0, 0] > 125  # not every version of OpenCV turns these
    assert len(notes_of_source(open_source(tmp_path))) == int(shown)


def test_a_picture_of_more_pixels_than_are_read_is_refused(tmp_path):
    path = tmp_path / "0.png"
    cv2.imwrite(str(path), np.zeros((1, 1), dtype=np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">2I", 100_000, 100_000)  # width and height in the header, with its checksum
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"0\.png cannot be decoded as an image"):
        list(open_source(tmp_path))


def test_a_video_that_is_upside_down_is_named(tmp_path):
    """Half a turn in the matrix of the track header (ISO 14496-12, 8.3.2), as of a phone held the other way round."""
    path = make_video(tmp_path / "clip.mp4", "mp4v", n_frames=2)
    expected, data = next(iter(open_source(path))).image, bytearray(path.read_bytes())
    assert notes_of_source(open_source(path)) == ()
    start = data.index(b"tkhd") + 4 + 40
    data[start : start + 36] = struct.pack(">9i", -(1 << 16), 0, 0, 0, -(1 << 16), 0, 96 << 16, 64 << 16, 1 << 30)
    path.write_bytes(data)
    source = open_source(path)
    np.testing.assert_array_equal(next(iter(source)).image, expected[::-1, ::-1])
    assert "marked as upside down" in notes_of_source(source)[0]


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


def test_a_browser_s_recording_is_counted_and_timed(tmp_path, monkeypatch):
    """A WebM declares no count, and milliseconds for its rate: 5 frames, 40 ms apart, would be 200 of 1 ms."""
    path, original = make_video(tmp_path / "clip.mkv", "MJPG", n_frames=5), cv2.VideoCapture

    class Recorded:
        def __init__(self, name):
            self.capture = original(name)

        def __getattr__(self, name):
            return getattr(self.capture, name)

        def get(self, what):
            declared = {cv2.CAP_PROP_FPS: 1000.0, cv2.CAP_PROP_FRAME_COUNT: 200.0}
            return declared[what] if what in declared else self.capture.get(what)

    monkeypatch.setattr(cv2, "VideoCapture", Recorded)
    source = open_source(path)
    assert len(source) == 5
    assert source.fps == pytest.approx(25.0)
    assert [frame.timestamp for frame in source] == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16])


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


def test_a_video_whose_edit_list_leaves_frames_out_is_whole(tmp_path):
    """As `ffmpeg -ss` cuts it: the edit begins at the sixth frame (ISO 14496-12, 8.6.6); one cut short is refused."""
    path = make_video(tmp_path / "clip.mp4", "mp4v")
    data = bytearray(path.read_bytes())
    scale = struct.unpack(">I", data[data.index(b"mdhd") + 16 : data.index(b"mdhd") + 20])[0]
    start = data.index(b"elst") + 12
    movie = struct.unpack(">I", data[data.index(b"mvhd") + 16 : data.index(b"mvhd") + 20])[0]
    data[start : start + 8] = struct.pack(">Ii", movie * 7 // 25, scale * 5 // 25)
    path.write_bytes(data)
    frames = list(open_source(path))
    assert 0 < len(frames) < 12
    assert frames[-1].index == len(frames) - 1
    with pytest.raises(SourceError, match=rf"clip\.mp4 ends with frame {len(frames) - 1}: choose a range"):
        list(open_source(path, 0, 11))
    path.write_bytes(data + struct.pack(">I", 1000) + b"mdat")
    with pytest.raises(SourceError, match=r"clip\.mp4 breaks off at frame"):
        list(open_source(path))


@pytest.mark.parametrize("name", ["groundtruth.txt", "notes.nfo", "log.vt"])
def test_text_is_no_video_whatever_its_name(tmp_path, name):
    """FFmpeg draws the lines of files with such names as pictures."""
    path = tmp_path / name
    path.write_text("".join(f"{k / 30:.6f} 0.1 0.2 0.3 0 0 0 1\n" for k in range(200)))
    with pytest.raises(SourceError, match=f"{name} holds text and no video"):
        open_source(path)


def test_video_without_its_index_cannot_be_opened(tmp_path):
    path = make_video(tmp_path / "clip.mp4", "mp4v")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"clip\.mp4 cannot be opened as a video"):
        open_source(path)


def test_missing_path_empty_folder_and_file_that_is_no_video(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mp4").write_text("hello")
    for name, message in (
        ("nowhere", r"no folder of images and no video at .*nowhere"),
        ("empty", "holds no images"),
        ("text.mp4", r"text\.mp4 cannot be opened"),
    ):
        with pytest.raises(SourceError, match=message):
            open_source(tmp_path / name)


@pytest.mark.parametrize(
    ("first", "last", "message"),
    [(0, 3, "frame 0 "), (1, 11, "frame 11 "), (1, 5, "frame 5 "), (3, 2, "before the first")],
)
def test_range_that_the_folder_does_not_have(folder, first, last, message):
    with pytest.raises(SourceError, match=message):
        open_source(folder, first, last)


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


def test_image_that_is_not_one_or_of_another_size(folder):
    (folder / "shot-3.png").write_bytes(b"")
    with pytest.raises(SourceError, match=r"frame 3: .*shot-3\.png"):
        list(open_source(folder))
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


@pytest.mark.parametrize(
    ("names", "times"),
    [
        # By text, or by their last digits, these would be in another order.
        (("999.9.png", "1000.05.png", "1000.5.png"), (999.9, 1000.05, 1000.5)),
        (("1305031100.500000.png", "1305031101.033333.png", "1305031101.500000.jpg"), None),
        (("1305031100.5", "1305031101.25"), (1305031100.5, 1305031101.25)),
        (("1403636579763555584.png", "1403636579813555456.png"), (1403636579.763555584, 1403636579.813555456)),
        (("9999999999999999.png", "10000000000000000.png"), (9999999.999999999, 10000000.0)),
    ],
)
def test_names_that_are_times_give_order_and_timestamps(tmp_path, names, times):
    for number, name in enumerate(names):
        picture = cv2.imencode(".png", grey(10 * number))[1].tobytes()
        (tmp_path / name).write_bytes(picture)
    source = open_source(tmp_path)
    frames = list(source)
    assert [frame.index for frame in frames] == list(range(len(names)))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [10 * number for number in range(len(names))]
    times = times or (1305031100.5, 1305031101.033333, 1305031101.5)
    np.testing.assert_allclose([frame.timestamp for frame in frames], times, rtol=0, atol=3e-7)
    assert [frame.index for frame in open_source(tmp_path, 1, 1)] == [1]


@pytest.mark.parametrize("parts", [10**3, 10**6, 10**9])
@pytest.mark.parametrize(("start", "fps"), [(1_700_000_000, 30.0), (1_700_000_000, 5.0), (20_000_000_000, 240.0)])
def test_the_unit_of_names_is_that_of_a_camera_s_rate(tmp_path, parts, start, fps):
    """Milliseconds, microseconds and nanoseconds since 1970, or of another clock."""
    taken = [start + k / fps for k in range(5)]
    for time in taken:
        cv2.imwrite(str(tmp_path / f"{int(time * parts)}.png"), grey(1))
    source = open_source(tmp_path)
    np.testing.assert_allclose([frame.timestamp for frame in source], taken, rtol=0, atol=1.001e-3)
    assert source.fps == pytest.approx(fps, rel=0.05)
    assert notes_of_source(source, readout_s=0.03) == ()


@pytest.mark.parametrize("parts", ["{:%Y%m%d%H%M%S}", "{:%Y%m%d%H%M%S}{milli:03}", "{:%Y%m%d%H%M%S%f}"])
def test_names_that_are_dates_are_times(tmp_path, parts):
    """Across the end of a minute, of a day and of a leap month, by numpy's own dates."""
    step = 1.0 if "f" not in parts and "milli" not in parts else 0.1
    start = datetime(2024, 2, 29, 23, 59, 58)
    dates = [start + k * timedelta(seconds=step) for k in range(30)]
    for date in dates:
        cv2.imwrite(str(tmp_path / f"{parts.format(date, milli=date.microsecond // 1000)}.png"), grey(1))
    found = [frame.timestamp for frame in open_source(tmp_path)]
    expected = (np.array(dates, dtype="datetime64[us]") - np.datetime64(0, "us")) / np.timedelta64(1, "s")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("point", ["", "."])
def test_dates_with_and_without_parts_of_a_second_are_in_the_order_of_time(tmp_path, point):
    names = ["20240131123059", f"20240131123059{point}500", "20240131123100", f"20240131123100{point}500000"]
    for number, name in enumerate(names):
        cv2.imwrite(str(tmp_path / f"{name}.png"), grey(10 * number))
    frames = list(open_source(tmp_path))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 10, 20, 30]
    seconds = [(datetime(2024, 1, 31, 12, 30, 59) - datetime(1970, 1, 1)).total_seconds() + k / 2 for k in range(4)]
    assert [frame.timestamp for frame in frames] == seconds
    cv2.imwrite(str(tmp_path / "20240131123100000.png"), grey(0))
    with pytest.raises(SourceError, match="two images of the same time"):
        open_source(tmp_path)


def test_long_numbers_that_follow_each_other_are_those_of_frames(tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{2026010100000 + number}.png"), grey(1))
    assert [frame.index for frame in open_source(tmp_path)] == [2026010100000, 2026010100001, 2026010100002]


def test_the_rate_of_numbered_images_is_given(folder, tmp_path):
    """Nothing else tells it; a rolling shutter counts by it."""
    assumed = open_source(folder)
    assert "30 a second are assumed" in notes_of_source(assumed, readout_s=0.03)[0]
    assert notes_of_source(assumed) == ()
    for opened in (open_source(folder, 2, 10, fps=15.0), open_stream(folder, 2, fps=15.0)):
        assert [frame.timestamp for frame in opened] == pytest.approx([2 / 15, 3 / 15, 10 / 15])
        assert opened.fps == 15.0
        assert notes_of_source(opened, readout_s=0.03) == ()
    with open_live(folder, fps=15.0) as live:
        assert live.fps == 15.0
    with pytest.raises(SourceError, match="fps is -1"):
        open_source(folder, fps=-1)
    with pytest.raises(SourceError, match=r"clip\.avi says the times of its frames itself: leave --fps out"):
        open_source(make_video(tmp_path / "clip.avi", "MJPG"), fps=15.0)


def test_the_rate_of_images_named_by_times_is_theirs(tmp_path):
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{1000.0 + 0.05 * number:.6f}.png"), grey(number))
    assert open_source(tmp_path).fps == pytest.approx(20.0)


def test_names_of_which_not_all_are_times_are_numbers(tmp_path):
    """And two images of one time are refused."""
    for name in ("1.5.png", "shot-2.png"):
        cv2.imwrite(str(tmp_path / name), grey(1))
    assert [frame.index for frame in open_source(tmp_path)] == [2, 5]
    (tmp_path / "shot-2.png").rename(tmp_path / "1.50.png")
    with pytest.raises(SourceError, match=r"two images of the same time, 1\.5\.png and 1\.50\.png: keep one"):
        open_source(tmp_path)


def save_image(path, value, size=(12, 16)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((*size, 3), value, dtype=np.uint8))


def save_depth(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.asarray(values, dtype=np.uint16))


@pytest.fixture
def tum(tmp_path):
    times = ("1305031102.1753", "1305031102.2113", "1305031102.2433")
    for number, time in enumerate(times):
        save_image(tmp_path / "rgb" / f"{time}.png", 10 * number)
    (tmp_path / "rgb.txt").write_text(
        "# color images\n# timestamp filename\n" + "".join(f"{t} rgb/{t}.png\n" for t in times)
    )
    depth = np.full((12, 16), 7500)
    depth[0, 0], depth[0, 1] = 0, 65535
    save_depth(tmp_path / "depth" / "a.png", depth)
    save_depth(tmp_path / "depth" / "b.png", depth + 1)
    # 4 ms after the first image, 30 ms after the last; nothing close to the second.
    (tmp_path / "depth.txt").write_text("1305031102.1793 depth/a.png\n1305031102.2733 depth/b.png\n")
    return tmp_path


def test_tum_keeps_time_and_depth(tum):
    source = open_source(tum)
    frames = list(source)
    assert len(source) == 3
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.timestamp for frame in frames] == [1305031102.1753, 1305031102.2113, 1305031102.2433]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 10, 20]
    depth = frames[0].depth
    assert depth.dtype == np.float32
    assert np.isnan(depth[0, :2]).all()
    assert depth[1, 1] == pytest.approx(1.5)
    assert [frame.depth is None for frame in frames] == [False, True, True]
    assert source.fps == pytest.approx(1.0 / 0.034, rel=1e-3)
    assert [frame.index for frame in open_source(tum, 1, 1)] == [1]


def test_depth_of_another_clock_says_how_far_it_is_off(tum):
    assert open_source(tum).depth_off_s is None
    (tum / "depth.txt").write_text("1305031102.7433 depth/a.png\n1305031103.2733 depth/b.png\n")
    source = open_source(tum)
    assert not source.has_registered_depth
    assert source.depth_off_s == pytest.approx(0.5)
    options = SimpleNamespace(use_depth=True)
    said, run = r"within 20 ms of a frame, the nearest 0\.5 s from one", SimpleNamespace(frames=tum)
    with open_live(tum) as live:
        for each in (source, SynchronizedFrames([source, source]), live):
            with pytest.raises(TrackingError, match=said):
                check_depth(run, [SimpleNamespace(options=options)], each)
    with pytest.raises(SourceError, match=said):
        open_source(tum, depth_per_metre=1000.0)
    for values_per_metre in (None, 1000.0):
        with pytest.raises(EvaluationError, match=said):
            list(read_depths(tum, range(3), values_per_metre))


def test_slam_says_that_it_leaves_depth_of_another_clock_aside(tum, tmp_path):
    (tum / "depth.txt").write_text("1305031102.7433 depth/a.png\n1305031103.2733 depth/b.png\n")
    save_camera(tmp_path / "camera.yaml", Camera(16, 12, 20.0, 20.0, 8.0, 6.0))
    told = run_slam(tum, tmp_path / "camera.yaml", tmp_path / "run", video=False, progress=False)
    assert any("the nearest 0.5 s from one" in flag and "left aside" in flag for flag in told["flags"])


def test_hidden_files_beside_images_are_no_images(tmp_path):
    """A Mac leaves one for each picture on drives of other systems."""
    for number in range(3):
        save_image(tmp_path / f"{number:06d}.png", number)
        (tmp_path / f"._{number:06d}.png").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X        ")
    assert [frame.index for frame in open_source(tmp_path)] == [0, 1, 2]


def test_tum_without_depth_and_with_a_broken_list(tum):
    (tum / "depth.txt").unlink()
    assert next(iter(open_source(tum))).depth is None
    (tum / "rgb.txt").write_text("1305031102.1 rgb/a.png more\n")
    with pytest.raises(SourceError, match=r"rgb\.txt, line 1: .* is not a timestamp and a file"):
        open_source(tum)
    (tum / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(SourceError, match="holds no frames"):
        open_source(tum)


def test_depth_of_another_kind_or_size(tum):
    save_image(tum / "depth" / "a.png", 3)
    with pytest.raises(SourceError, match=r"frame 0: .*a\.png is not a depth image"):
        list(open_source(tum))
    save_depth(tum / "depth" / "a.png", np.ones((6, 8)))
    with pytest.raises(SourceError, match=r"frame 0: .*a\.png is 8x6 pixels, the frames before it are 16x12"):
        list(open_source(tum))


@pytest.fixture
def euroc(tmp_path):
    stamps = {"cam0": (1403636579763555584, 1403636579813555456), "cam1": (1403636579813555456,)}
    for camera, times in stamps.items():
        folder = tmp_path / "mav0" / camera
        for number, time in enumerate(times):
            save_image(folder / "data" / f"{time}.png", 50 * number + 100 * (camera == "cam1"))
        rows = "".join(f"{time},{time}.png\r\n" for time in times)
        (folder / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
    return tmp_path


def test_euroc_pairs_left_and_right(euroc):
    for folder in (euroc, euroc / "mav0"):
        first, second = open_source(folder)
        assert first.timestamp == pytest.approx(1403636579.763555584, abs=3e-7, rel=0)
        assert second.timestamp - first.timestamp == pytest.approx(0.05, abs=1e-6)
        assert first.right is None
        assert (int(second.image[0, 0, 0]), int(second.right[0, 0, 0])) == (50, 100)
    (euroc / "mav0" / "cam0" / "data.csv").write_text("yesterday,a.png\n")
    with pytest.raises(SourceError, match=r"data\.csv, line 1: .* is not a timestamp in nanoseconds"):
        open_source(euroc)


def test_seven_scenes_by_number(tmp_path):
    for number in (3, 4):
        save_image(tmp_path / f"frame-{number:06}.color.png", number)
        (tmp_path / f"frame-{number:06}.pose.txt").write_text("1")
    save_depth(tmp_path / "frame-000004.depth.png", [[1500, 0, 65535, 2000] * 4] * 12)
    first, second = open_source(tmp_path)
    assert (first.index, first.timestamp, first.depth) == (3, 0.1, None)
    np.testing.assert_allclose(second.depth[0, :4], [1.5, np.nan, np.nan, 2.0])
    with pytest.raises(SourceError, match="frame 5 is not in"):
        open_source(tmp_path, 3, 5)


def test_the_recipe_registers_depth_to_the_colour(tmp_path):
    """A wall at 2 m and before its left half another at 1 m, in a depth camera to the right of the colour camera."""
    stored = np.full((480, 640), 2000, np.uint16)
    stored[:, :320], stored[:8] = 1000, 65535
    for number in (0, 1):
        cv2.imwrite(str(tmp_path / f"frame-{number:06d}.color.png"), np.zeros((480, 640, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "frame-000001.depth.png"), stored)
    (recipe,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "sources.md").read_text(), flags=re.DOTALL)
    exec(recipe.replace('"seq-01"', repr(str(tmp_path))), {})
    source = open_source(tmp_path)
    assert source.has_registered_depth
    first, second = source
    assert (first.depth, second.timestamp) == (None, pytest.approx(1.0 / 30.0, abs=1e-6))
    # The edge is in column 319.5: 1 m away, its point is 525 (-0.5 / 585 + 0.025) = 12.7 px right of the middle.
    row = second.depth[240]
    seen = np.isfinite(row)
    assert np.nanmax(row[:320]) == 1.0
    assert row[seen][np.flatnonzero(seen) > 334] == pytest.approx(2.0)
    assert np.flatnonzero(row == 1.0).max() in (332, 333)
    # 585 columns of the depth camera are 525 of the colour camera, so none is left out between them.
    assert seen[60:320].all()


def test_the_real_seven_scenes_recording():
    source = open_source(real_data("7scenes_redkitchen"), 10, 11)
    with_depth, without = source
    assert with_depth.image.shape == (480, 640, 3)
    # A kitchen: depths between half a metre and five.
    assert 0.5 < np.nanmedian(with_depth.depth) < 5.0
    assert without.depth is None


def picture(position):
    image = np.full((96, 128, 3), 40, dtype=np.uint8)
    cv2.circle(image, (20 + 8 * position, 48), 10, (30, 200, 230), -1)
    return image


def write_video(path, n_frames, error=None):
    with VideoWriter(path, 25.0, (128, 96)) as writer:
        for position in range(n_frames):
            writer.write(picture(position))
        if error:
            raise error


def test_frames_read_back(tmp_path):
    write_video(tmp_path / "out.mp4", 10)
    source = open_source(tmp_path / "out.mp4")
    frames = list(source)
    assert len(frames) == len(source) == 10
    assert source.fps == pytest.approx(25.0)
    for position, read in enumerate(frames):
        assert np.abs(read.image.astype(float) - picture(position)).mean() < 4.0
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]


def test_interrupted_video_plays_what_was_written(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "out.mp4", 4, KeyboardInterrupt())
    assert len(list(open_source(tmp_path / "out.mp4"))) == 4


def test_no_frames_no_file_and_the_older_video_stays(tmp_path):
    write_video(tmp_path / "out.mp4", 3)
    write_video(tmp_path / "out.mp4", 0)
    assert len(list(open_source(tmp_path / "out.mp4"))) == 3


def test_video_on_a_full_disk_is_an_error_and_leaves_nothing_that_does_not_play(tmp_path):
    write_video(tmp_path / "out.mp4", 1)
    with largest_file(1024), pytest.raises(SourceError, match="was not written whole, it is left out"):
        write_video(tmp_path / "out.mp4", 40)
    assert not list(tmp_path.iterdir())


def test_interrupt_goes_on_where_the_video_is_lost_as_well(tmp_path, caplog):
    with largest_file(1024), pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "out.mp4", 40, KeyboardInterrupt())
    assert "was not written whole" in caplog.text


def test_missing_folder(tmp_path):
    with pytest.raises(SourceError, match="there is no folder"):
        write_video(tmp_path / "missing" / "out.mp4", 1)


def test_frame_of_another_size_is_refused(tmp_path):
    with VideoWriter(tmp_path / "out.mp4", 25.0, (128, 96)) as writer, pytest.raises(ValueError, match="128x96"):
        writer.write(np.zeros((48, 64, 3), dtype=np.uint8))


class FilmOfArrays:
    """Images in one .npy file (n, h, w, 3) as a source: all that a new kind of source needs."""

    fps = 25.0

    def __init__(self, path, first=None, last=None):
        self.name, self.images = str(path), np.load(path)
        first, last = check_range(path, range(len(self.images)), first, last)
        self.numbers = range(first, last + 1)

    def __len__(self):
        return len(self.numbers)

    def __iter__(self):
        return (Frame(k, k / self.fps, self.images[k]) for k in self.numbers)


def test_a_registered_kind_of_source_opens_as_any_other(tmp_path):
    register_source(lambda path: path.suffix == ".npy", FilmOfArrays)
    np.save(tmp_path / "film.npy", np.arange(4, dtype=np.uint8)[:, None, None, None] * np.ones((8, 6, 3), np.uint8))
    for opened in (open_source, open_stream):
        assert [(f.index, int(f.image[0, 0, 0])) for f in opened(tmp_path / "film.npy", 1, 2)] == [(1, 1), (2, 2)]
    with open_live(tmp_path / "film.npy", 3) as stream:
        assert [frame.index for frame in stream] == [3]
    assert open_source(tmp_path / "film.npy", 2).images.shape == (4, 8, 6, 3)  # an attribute of its own
    with pytest.raises(SourceError, match=r"frame 9 is not in .*film\.npy"):
        open_source(tmp_path / "film.npy", 9)


class Items:
    """A source of any items, without a length."""

    name, fps = "items", 10.0

    def __init__(self, *items):
        self.items = items

    def __iter__(self):
        return iter(self.items)


class Listed(Items):
    """One with a length."""

    def __len__(self):
        return len(self.items)


def numbered(*numbers):
    return [Frame(number, 0.1 * place, grey(0)) for place, number in enumerate(numbers)]


@pytest.mark.parametrize(
    ("opened", "message", "n_before"),
    [
        (None, r"film\.any opens it as an object of type NoneType, without name: return one with name, fps", 0),
        (numbered(0), "of type list, without name", 0),
        (Items(*numbered(0)), r"film\.any has no length, .* give what opens it a method __len__", 0),
        (Listed(*numbered(3, 4, 4)), "items gives frame 4 after frame 4: number frames in the order", 2),
        (Listed(*numbered(4, 2)), "items gives frame 2 after frame 4", 1),
        (Listed(grey(0)), "items gives an object of type ndarray at first: give md.Frame objects", 0),
        (Listed(*numbered(4), None), "items gives an object of type NoneType after frame 4", 1),
    ],
)
def test_mistakes_of_a_registered_source_are_named(opened, message, n_before, tmp_path, monkeypatch):
    """The frames before the mistake come first."""
    monkeypatch.setattr(sources, "_KINDS", list(sources._KINDS))
    register_source(lambda path: path.suffix == ".any", lambda path, first, last: opened)
    before = []
    with pytest.raises(SourceError, match=message):
        before.extend(open_source(tmp_path / "film.any"))
    assert len(before) == n_before
    if type(opened) is Items:
        assert [frame.index for frame in open_stream(tmp_path / "film.any")] == [0]


def test_numbers_of_numpy_become_numbers_that_json_knows():
    frame = Frame(np.int64(3), np.float32(0.5), grey(0), captured=np.float64(2.5))
    assert json.dumps([frame.index, frame.timestamp, frame.captured]) == "[3, 0.5, 2.5]"
    again = replace(frame, index=np.uint8(4), timestamp=np.int64(7))
    assert json.dumps([again.index, again.timestamp]) == "[4, 7.0]"
    with pytest.raises(SourceError, match=r"number 1\.5"):
        Frame(1.5, 0.0, grey(0))


def test_a_picture_before_a_short_video_is_whole_and_one_behind_a_preview_may_be_cut_short(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    preview = b"\xff\xe1" + (2 + len(data)).to_bytes(2, "big") + data
    path = tmp_path / "photo.jpg"
    path.write_bytes(data + b"\0\0\0\x18ftypmp42" + bytes(5000))
    np.testing.assert_array_equal(read_image(path, "photo"), cv2.imdecode(np.frombuffer(data, np.uint8), 1))
    path.write_bytes(data[:2] + preview + data[2:])
    assert read_image(path, "photo").shape == picture.shape
    path.write_bytes(data[:2] + preview + data[2 : len(data) // 2])
    with pytest.raises(SourceError, match="is cut short"):
        read_image(path, "photo")


def test_a_list_of_images_that_is_no_text_is_named(tmp_path):
    (tmp_path / "rgb.txt").write_bytes("# Gerät\n1.0 a.png\n".encode("latin-1"))
    with pytest.raises(SourceError, match=r"rgb\.txt is not a text file"):
        open_source(tmp_path)
