"""A live camera drops frames rather than falling behind; a recording never does. Threads meanwhile."""

import gc
import socket
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from morph_dslam.errors import ArgumentError, SourceError
from morph_dslam.sources import open_live, open_source, open_stream, register_source
from morph_dslam.sources.frames import Frame
from morph_dslam.sources.live import LiveCamera, Newest, PacedRecording
from morph_dslam.sources.local_socket import FRAME_HEAD, MOST_BYTES, PICTURE_HEAD
from morph_dslam.threads import ahead, one_openblas_thread, one_thread_for_algebra, threads_side_by_side


class FakeCapture:
    """Delivers frame after frame, each when the test lets it; image k is filled with k."""

    def __init__(self):
        self.opened = True
        self.asked, self.allowed = threading.Semaphore(0), threading.Semaphore(0)
        self.delivered = 0
        self.lost = False
        self.released = False
        self.image = np.zeros((4, 6, 3), dtype=np.uint8)

    def read(self):
        self.asked.release()
        self.allowed.acquire()
        if self.lost:
            return False, None
        # The same memory again and again, as drivers do.
        self.image[:] = self.delivered
        self.delivered += 1
        return True, self.image

    def isOpened(self):
        return self.opened

    def get(self, propId):
        return 25.0

    def release(self):
        self.released = True


def deliver(capture, n_frames):
    """Let ``n_frames`` more come, and wait until the last of them is there to be taken."""
    for _ in range(n_frames):
        assert capture.asked.acquire(timeout=10.0)
        capture.allowed.release()
    # The reader asks again once it has handed the last one over.
    assert capture.asked.acquire(timeout=10.0)
    capture.asked.release()


def test_a_slow_consumer_gets_the_newest_frame():
    capture, clock = FakeCapture(), iter(range(100, 200))
    camera = LiveCamera(capture, "webcam 0", clock=lambda: float(next(clock)))
    frames = iter(camera)
    deliver(capture, 1)
    first = next(frames)
    deliver(capture, 9)
    second = next(frames)
    deliver(capture, 1)
    third = next(frames)
    assert [frame.index for frame in (first, second, third)] == [0, 9, 10]
    assert [int(frame.image[0, 0, 0]) for frame in (first, second, third)] == [0, 9, 10]
    assert [frame.timestamp for frame in (first, second, third)] == [0.0, 9.0, 10.0]
    assert [frame.captured for frame in (first, second, third)] == [100.0, 109.0, 110.0]
    assert camera.dropped == 8
    assert camera.fps == 25.0
    capture.allowed.release()
    camera.close()
    assert capture.released


def test_a_camera_that_is_unplugged():
    capture = FakeCapture()
    with LiveCamera(capture, "webcam 0") as camera:
        deliver(capture, 1)
        frames = iter(camera)
        next(frames)
        capture.lost = True
        capture.allowed.release()
        with pytest.raises(SourceError, match="webcam 0 stopped delivering after frame 0"):
            next(frames)
    assert capture.released


class Connection:
    """Delivers some images, each filled with a number, and breaks off."""

    def __init__(self, *levels):
        self.levels, self.released = list(levels), False

    def isOpened(self):
        return bool(self.levels)

    def read(self):
        return (True, np.full((4, 6, 3), self.levels.pop(0), dtype=np.uint8)) if self.levels else (False, None)

    def get(self, propId):
        return 25.0

    def release(self):
        self.released = True


def test_a_camera_on_the_network_is_connected_to_again_for_ten_seconds(monkeypatch, caplog):
    """An attempt takes 3 s; the third one succeeds. After its frame none does, and 12 s are over with the fourth."""
    monkeypatch.setattr("morph_dslam.sources.live.AGAIN_S", 0.0)
    clock, made = FakeClock(), [Connection(1, 2)]

    def reopen():
        clock.now += 3.0
        made.append(Connection(3) if len(made) == 3 else Connection())
        return made[-1]

    frames = []
    with LiveCamera(made[0], "rtsp://camera/1", clock, "check the network", reopen) as camera:
        with pytest.raises(SourceError, match="rtsp://camera/1 stopped delivering after frame 2: check the network"):
            frames.extend(camera)
        last = frames[-1]
        assert (last.index, last.timestamp, last.captured) == (2, 9.0, 59.0)
        assert int(last.image[0, 0, 0]) == 3
    assert len(made) == 1 + 3 + 4
    assert all(connection.released for connection in made)
    assert [line for line in caplog.messages if "rtsp://camera/1" in line] == [
        f"rtsp://camera/1 stopped delivering after frame {n}: connecting again, for 10 seconds at most ..."
        for n in (1, 2)
    ]


def test_a_recording_gives_every_frame_to_a_slow_consumer(tmp_path):
    for number in range(5):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4, 6, 3), number, dtype=np.uint8))
    frames = iter(open_stream(tmp_path))
    seen = [next(frames).index]
    # Whatever happens between two frames, the next one is the next one.
    threading.Event().wait(0.05)
    seen += [frame.index for frame in frames]
    assert seen == [0, 1, 2, 3, 4]


class Film:
    """A recording of five frames, ten a second, numbered from 3."""

    name, fps = "film", 10.0

    def __iter__(self):
        for k in range(5):
            yield Frame(3 + k, 7.0 + 0.1 * k, np.full((2, 2, 3), k, dtype=np.uint8))


class FakeClock:
    """Time passes only while somebody sleeps, and when the test says so."""

    def __init__(self):
        self.now, self.slept = 50.0, []

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


def test_a_recording_plays_at_its_own_pace():
    clock = FakeClock()
    stream = PacedRecording(Film(), clock, clock.sleep)
    frames = []
    for frame in stream.read():
        frames.append(frame)
        if frame.index == 4:
            clock.now += 0.25  # something else took long: two frames come late
    assert [frame.index for frame in frames] == [3, 4, 5, 6, 7]
    assert [frame.timestamp for frame in frames] == pytest.approx([7.0, 7.1, 7.2, 7.3, 7.4])
    assert [frame.captured for frame in frames] == pytest.approx([50.0, 50.1, 50.35, 50.35, 50.4])
    assert clock.slept == pytest.approx([0.1, 0.05])


def test_a_recording_that_plays_ends_with_its_newest_frame_and_tells_its_errors():
    with PacedRecording(Film(), sleep=lambda seconds: None) as stream:
        assert [frame.index for frame in stream][-1] == 7

    class Broken(Film):
        def __iter__(self):
            yield next(super().__iter__())
            raise SourceError("frame 4 is damaged")

    with (
        PacedRecording(Broken(), sleep=lambda seconds: None) as stream,
        pytest.raises(SourceError, match="frame 4 is damaged"),
    ):
        list(stream)


def test_the_newest_item_is_taken_and_an_error_comes_last():
    place = Newest()
    place.put("old")
    place.put("new")
    place.end(SourceError("gone"))
    assert place.take() == "new"
    assert place.dropped == 1
    with pytest.raises(SourceError, match="gone"):
        place.take()


@pytest.mark.parametrize("name", ["webcam:97", "/dev/video97"])
def test_webcams_that_cannot_be_opened(name):
    with pytest.raises(SourceError, match="webcam 97 cannot be opened"):
        open_stream(name)


def test_names_that_are_no_cameras_and_ranges_of_cameras():
    with pytest.raises(ArgumentError, match="'webcam:0' for the first webcam"):
        open_stream(0)
    for name in ("webcam", "webcam:x"):
        with pytest.raises(SourceError, match=f"at {name} .*webcam:0"):
            open_stream(name)
    with pytest.raises(SourceError, match="is live and has no range"):
        open_stream("webcam:0", 3, 4)
    with PacedRecording(Film()) as stream:
        register_source(lambda path: str(path) == "fake:live", lambda *_: stream)
        with pytest.raises(SourceError, match="fake:live is live"):
            open_source("fake:live")


@pytest.fixture
def nothing_frozen():
    """The tests leave out all that they have imported when they look for garbage."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("nothing_frozen")
def test_what_a_program_leaves_out_when_it_looks_for_garbage_is_its_own_choice():
    first = [[]]  # what looks for garbage has a list of lists to look at
    gc.freeze()
    second = [[]]
    with threads_side_by_side():
        looked_at = [id(item) for item in gc.get_objects()]
    assert (id(first) in looked_at, id(second) in looked_at) == (False, True)
    assert gc.get_freeze_count() > 10_000


@pytest.mark.usefixtures("nothing_frozen")
def test_threads_take_turns_quickly_only_while_they_track():
    def settings():
        return sys.getswitchinterval(), cv2.getNumThreads(), gc.get_freeze_count()

    def interrupted():
        with threads_side_by_side():
            inside.append(settings())
            raise KeyboardInterrupt

    before, inside = settings(), []
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    interval, threads, frozen = inside[0]
    # Fifty waits take less than a sixth of a frame of 30 a second.
    assert 50 * interval < 1 / 180
    assert threads == 1
    assert frozen > 10_000
    assert settings() == before


def algebra_threads():
    """Of the libraries that numpy and scipy call; other packages bring their own."""
    pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    return [pool["num_threads"] for pool in pools if "numpy" in pool["filepath"] or "scipy" in pool["filepath"]]


@one_thread_for_algebra
def product(size):
    """The sum of a product of matrices of ones, and how many threads it may take."""
    return float((np.ones((size, size)) @ np.ones((size, size))).sum()), algebra_threads()


def test_linear_algebra_runs_in_one_thread_meanwhile_and_as_before_afterwards():
    before = algebra_threads()
    total, meanwhile = product(size=40)
    assert total == 40.0**3
    assert meanwhile
    assert set(meanwhile) == {1}
    assert algebra_threads() == before
    with ThreadPoolExecutor(1) as other:  # of a program that tracks beside its own work
        assert set(other.submit(product, size=4).result()[1]) == {1}
    assert algebra_threads() == before


def test_a_build_leaves_the_threads_of_openblas_as_they_were():
    """Shared by threads, small matrices wait for a core that another program has."""
    with threadpool_limits(limits=2, user_api="blas"):
        with one_openblas_thread():
            meanwhile = algebra_threads()
        after = algebra_threads()
    assert meanwhile
    assert set(meanwhile) == {1}
    assert set(after) == {2}


def test_the_next_item_is_made_while_this_one_is_worked_on():
    made = threading.Event()

    def numbers():
        yield 1
        made.set()
        yield 2
        raise SourceError("the recording breaks off")

    items = ahead(numbers(), 1)
    assert next(items) == 1
    assert made.wait(timeout=10.0)
    assert next(items) == 2
    with pytest.raises(SourceError, match="breaks off"):
        next(items)
    # A frame may be missing where nobody asks for it.
    assert list(zip(range(2), ahead(numbers()), strict=False)) == [(0, 1), (1, 2)]


def test_who_stops_early_has_no_more_items_made():
    made = []

    def numbers():
        for number in range(1000):
            made.append(number)
            yield number

    items = ahead(numbers())
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    items.close()
    n_made = len(made)
    assert n_made <= 3 + 2
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("ahead")]
    assert len(made) == n_made


def sent(number, jpeg, seconds=0.0):
    return FRAME_HEAD.pack(number, seconds, len(jpeg)) + jpeg


@pytest.fixture
def sender(tmp_path):
    """A program that listens at a socket, its path, and what accepts who connects."""
    path = tmp_path / "camera.sock"
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        yield path, listening


def test_frames_come_over_a_socket_and_pictures_go_back(sender):
    path, listening = sender
    _, jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))
    with open_live(path) as stream:
        other, _ = listening.accept()
        with other:
            size = bytes(jpeg).find(b"\xff\xc0") + 5
            damaged = bytes(jpeg[:size]) + b"\xf0" * 4 + bytes(jpeg[size + 4 :])  # of 61680 times 61680 pixels
            other.sendall(sent(4, b"no picture at all") + sent(5, damaged) + sent(7, jpeg.tobytes(), 2.5))
            frame = next(iter(stream))
            assert (frame.index, frame.timestamp, frame.image.shape) == (7, 2.5, (48, 64, 3))
            assert np.abs(frame.image.astype(int) - 90).max() <= 2
            stream.show(7, b"picture")
            head = other.recv(PICTURE_HEAD.size, socket.MSG_WAITALL)
            assert PICTURE_HEAD.unpack(head) == (7, 7)
            assert other.recv(7, socket.MSG_WAITALL) == b"picture"
            other.sendall(sent(8, jpeg.tobytes())[:-5])  # it ends in the middle of a frame
        assert list(stream) == []
        stream.show(8, b"picture")  # for nobody


def test_times_over_a_socket_are_without_the_jitter_with_which_frames_came(sender):
    """A browser's frames, thirty a second, which the other program gets up to 4 ms late."""
    path, listening = sender
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    true = np.arange(90) / 30.0
    received, found = true + np.random.default_rng(0).uniform(0.0, 4e-3, len(true)), []
    with open_live(path) as stream:
        other, _ = listening.accept()
        with other:
            for number, seconds in enumerate(received):
                other.sendall(sent(number, jpeg, seconds))
                found.append(next(iter(stream)).timestamp)
    settled = slice(40, None)
    assert np.std((found - true)[settled]) < 0.75 * np.std((received - true)[settled])
    assert np.std(np.diff(found)[settled]) < 0.25 * np.std(np.diff(received)[settled])


def test_a_socket_is_let_go_while_nothing_comes(sender):
    path, listening = sender
    stream = open_live(path)
    other, _ = listening.accept()
    with other:
        stream.close()
        assert other.recv(1) == b""
    assert list(stream) == []


def test_sockets_that_cannot_be_used(sender):
    path, listening = sender
    with pytest.raises(SourceError, match="is live and has no range"):
        open_stream(path, 2, 3)
    with open_live(path) as stream:
        other, _ = listening.accept()
        with other:
            other.sendall(FRAME_HEAD.pack(0, 0.0, MOST_BYTES + 1))
            with pytest.raises(SourceError, match="sent 8000001 bytes as frame 0"):
                list(stream)
    listening.close()
    with pytest.raises(SourceError, match=r"does not answer .*: the studio that made it has ended"):
        open_stream(path)


class Served:
    """A server on this computer that sends a film to everyone who connects, and then falls silent, or hangs up.

    Parameters
    ----------
    parts : of the film.
    hangs_up : whether the first who connects is cut off behind it.
    """

    def __init__(self, parts, hangs_up=False):
        self.hangs_up = hangs_up
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.connections = []
        self.thread = threading.Thread(target=self.serve, args=(parts,), daemon=True)
        self.thread.start()

    def serve(self, parts):
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            self.connections.append(connection)
            if parts:
                connection.recv(4096)
            for part in parts:
                connection.sendall(part)
            if self.hangs_up and len(self.connections) == 1:
                connection.shutdown(socket.SHUT_RDWR)

    def close(self):
        self.listener.shutdown(socket.SHUT_RDWR)
        self.thread.join()
        self.listener.close()
        for connection in self.connections:
            connection.close()


def motion_jpeg(levels):
    """The parts of a film whose pictures are grey."""
    parts = [b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n"]
    for level in levels:
        jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), level, np.uint8))[1].tobytes()
        parts.append(b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(jpeg), jpeg))
    return parts


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr("morph_dslam.sources.frames.NETWORK_TIMEOUT_MS", 700)


@pytest.mark.usefixtures("impatient")
def test_a_camera_on_the_network(capfd):
    """Pictures as motion JPEG over HTTP, as network cameras send them; then silence, of which OpenCV says nothing."""
    server = Served(motion_jpeg(range(0, 240, 2)))
    try:
        with open_live(f"http://user:secret@{server.address}/video") as camera:
            assert camera.name == f"http://{server.address}/video"
            levels = []
            with pytest.raises(SourceError, match=r"/video stopped delivering after frame \d+: check the network"):
                levels.extend(int(frame.image[24, 32, 0]) for frame in camera)
    finally:
        server.close()
    assert levels
    assert levels == sorted(set(levels))
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("impatient")
def test_a_camera_on_the_network_that_hangs_up_is_connected_to_again(caplog):
    server = Served(motion_jpeg(range(0, 240, 4)), hangs_up=True)
    frames = []
    try:
        with open_live(f"http://{server.address}/video") as camera, pytest.raises(SourceError, match="stopped deliver"):
            frames.extend(camera)
    finally:
        server.close()
    assert len(server.connections) == 2
    assert frames[-1].index >= 60  # of the second connection: the film has 60 pictures
    assert "connecting again" in caplog.text


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("scheme", ["rtsp", "http"])
def test_an_address_that_is_silent_or_dead_ends_in_one_message(scheme):
    server = Served([])
    try:
        with pytest.raises(SourceError, match=f"no video comes from {scheme}://{server.address}/x: check the address"):
            open_stream(f"{scheme}://{server.address}/x")
    finally:
        server.close()
    with pytest.raises(SourceError, match="no video comes from"):
        open_stream(f"{scheme}://{server.address}/x")
