"""Where live pictures go: a video that keeps the time, and a browser on this computer."""

import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from morph_dslam.errors import TrackingError
from morph_dslam.sources import Frame
from morph_dslam.tracking.sinks import BrowserSink, LiveTimes, TrackedFrame, VideoSink

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
