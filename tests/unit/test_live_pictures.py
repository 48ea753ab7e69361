"""Where live pictures go: a video that keeps the time, and a browser on this computer."""

import subprocess
import sys
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from morph_dslam.errors import TrackingError
from morph_dslam.sources import Frame
from morph_dslam.tracking.repeated_pictures import RepeatedPictures
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sinks import BrowserSink, LiveTimes, TrackedFrame, VideoSink
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import PROJECT
from tests.support.run_folders import CAMERA
from tests.unit.test_results import frame_result

BLUE = np.full((40, 60, 3), (200, 30, 20), dtype=np.uint8)


class Written:
    """Keeps what a video would get."""

    def __init__(self):
        self.values = []

    def write(self, image):
        self.values.append(int(image[0, 0, 0]))


def shown(picture, seconds=0.0):
    return TrackedFrame((Frame(0, seconds, picture),), {}, picture)


def test_a_video_stands_still_where_frames_were_dropped_and_leaves_out_long_gaps():
    video = Written()
    sink = VideoSink(video, 10.0)
    for value, seconds in ((1, 5.0), (2, 5.1), (3, 5.4), (4, 5.41), (5, 60.0), (6, 60.2)):
        sink(shown(np.full((2, 2, 3), value, dtype=np.uint8), seconds))
    # The third came 0.3 s after the second; the fourth at once: time goes on from there, as after the gap.
    assert video.values == [1, 2, 3, 3, 3, 4, 5, 6, 6]


def test_a_browser_gets_the_newest_picture():
    with BrowserSink(0) as sink:
        sink(shown(BLUE))  # nobody looks
        with urllib.request.urlopen(sink.address) as page:
            assert b"/stream.mjpg" in page.read()
        with urllib.request.urlopen(sink.address + "stream.mjpg") as stream:
            while not sink.is_watched:
                pass
            sink(shown(BLUE))
            assert stream.readline() == b"--frame\r\n"
            headers = [stream.readline() for _ in range(3)]
            jpeg = stream.read(int(headers[1].split()[1]))
        found = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(found.astype(int) - BLUE).max() < 6
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(sink.address + "other")
        elsewhere = urllib.request.Request(sink.address, headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(elsewhere)
        with pytest.raises(TrackingError, match="cannot be taken"):
            BrowserSink(int(sink.address.rstrip("/").rpartition(":")[2]))


def test_how_fast_it_was():
    times = LiveTimes([3, 4, 6], [10.0, 10.1, 10.3], [0.02, 0.03, 0.05])
    assert times.fps == pytest.approx(2 / 0.3)
    assert times.latency_ms(50) == pytest.approx(30.0)
    assert np.isnan(LiveTimes().latency_ms(50))
    assert LiveTimes().fps == 0.0


def pictures(levels, fps=20.0):
    """Frames of a live camera, each filled with a level but for one pixel that has noise of its own."""
    for number, level in enumerate(levels):
        image = np.full((40, 60, 3), 90, dtype=np.uint8)
        image[37, 5, 1] = level
        yield Frame(3 + number, number / fps, image, captured=number / fps)


#: Noise in each frame; then the 11th picture, of frame 13, comes 15 times more, another 12 times, one 5 times.
FROZEN = [*range(11), *[10] * 15, *range(20, 25), *[24] * 12, 30, 31, *[31] * 5, 32]


def test_a_frozen_camera_is_named():
    watch = RepeatedPictures()
    for frame in pictures(FROZEN):
        watch.add(frame)
    (notice,) = watch.notices()
    # 15 repetitions at 20 a second last 0.75 s, 12 of them 0.6 s; 5 are over after 0.25 s.
    assert (notice.kind, notice.data["count"], notice.data["first"]) == ("same_picture", 27, 14)
    assert notice.data["longest_s"] == pytest.approx(0.75)
    assert "same picture again in 27 frames, first in frame 14" in notice.text


@pytest.mark.parametrize("levels", [list(range(60)), [0, 1] * 30, [7] * 10, [7] * 9 + [8] * 9])
def test_noise_and_short_repetitions_are_no_frozen_camera(levels):
    watch = RepeatedPictures()
    for frame in pictures(levels):
        watch.add(frame)
    assert watch.notices() == []


def test_a_frozen_camera_is_told_of_once_as_it_happens(caplog):
    times = LiveTimes()
    for frame in pictures(FROZEN[:26]):
        times(TrackedFrame((frame,), {}))
    assert caplog.messages == ["since frame 13 the camera delivers the same picture: it may be frozen"]


@pytest.mark.parametrize(("is_live", "kinds"), [(True, ["same_picture"]), (False, [])])
def test_a_frozen_camera_stands_in_the_folder_of_a_live_run_alone(is_live, kinds, tmp_path):
    run = RunFolder(tmp_path / "run", "sheet", RunResults(bent_sheet_model(22, 16), reference_frame=0), CAMERA)
    for number in range(8):
        frame = Frame(number, 0.1 * number, BLUE, captured=0.1 * number if is_live else None)
        result = frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False])
        run(TrackedFrame((frame,), {"sheet": result}))
    summary = run.write()
    assert [notice["kind"] for notice in summary["notices"] if notice["kind"] == "same_picture"] == kinds
    assert any("same picture again in 7 frames, first in frame 1" in flag for flag in summary["flags"]) is is_live


#: Counts what is compiled for drawing an object after a triangle was drawn.
FIRST_PICTURE = """
import sys
import numpy as np
from morph_dslam.render.overlay import blend_surface
from morph_dslam.tracking.compilation import compile_drawing
from morph_dslam.tracking.drawing import AugmentedView
from morph_dslam.tracking.estimator import State
from tests.support.run_folders import CAMERA
from tests.support.streamed import POSE, held_block_model

compile_drawing()
before = len(blend_surface.signatures), "matplotlib" in sys.modules
image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
drawn = AugmentedView(held_block_model(), CAMERA).draw(image, State(np.zeros(2), POSE), (0.0, 1.0), "")
print(*before, len(blend_surface.signatures), bool(drawn.any()))
"""


def test_what_draws_is_compiled_and_loaded_before_the_first_picture():
    """In a process of its own: here it may be compiled already."""
    ran = subprocess.run([sys.executable, "-c", FIRST_PICTURE], cwd=PROJECT, capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["1", "True", "1", "True"]
