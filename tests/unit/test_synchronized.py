"""Recordings of a rig whose frames go together by their times, where one camera lost some."""

from contextlib import ExitStack

import cv2
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.io.camera_files import save_rig
from morph_dslam.model import save_model
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import MissingFrame
from morph_dslam.tracking.placement import images_from
from morph_dslam.tracking.synchronized import SynchronizedFrames
from morph_dslam.tracking.track import prepare
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import FRONT, RIG, sheet_state, write_landmarks

EPOCH, RATE = 1_700_000_000.0, 10.0
N = 80


class Timed(list[Frame]):
    """Frames with times of their own, ten a second."""

    has_assumed_times, fps, name = False, RATE, "recorded"


def recorded(instants, image=None):
    """Frames that are numbered as they come, of instants of a tenth of a second."""
    image = np.zeros((4, 6, 3), dtype=np.uint8) if image is None else image
    return Timed(Frame(k, EPOCH + n / RATE, image) for k, n in enumerate(instants))


def without(first, count):
    """The instants but for some."""
    return [n for n in range(N) if not first <= n < first + count]


def instant_of(frame):
    return None if isinstance(frame, MissingFrame) else round((frame.timestamp - EPOCH) * RATE)


@pytest.mark.parametrize("n_lost", [5, 15])
def test_a_range_is_one_of_instants_and_not_of_each_cameras_own_numbers(n_lost):
    """Cut by their own numbers, the first frames left are half a second apart, or 1.5 s and taken for one instant."""
    both = SynchronizedFrames([recorded(range(N)), recorded(without(10, n_lost))], 40, 60)
    for _ in range(2):
        assert [[instant_of(frame) for frame in pair] for pair in both] == [[n, n] for n in range(40, 61)]
        assert (both.n_instants, both.n_missing, both.n_left_out, both.notices()) == (21, [0, 0], 0, [])
    assert len(both) == 21


def test_instants_that_the_first_camera_lacks_have_no_part_in_a_range_beside_them():
    """Frame 40 of the first camera is of instant 42 then, and the range begins and ends beside lost frames."""
    first, second = without(40, 2), list(range(N))
    both = SynchronizedFrames([recorded(first), recorded(second)], 40, 45)
    assert [[instant_of(frame) for frame in pair] for pair in both] == [[n, n] for n in range(42, 48)]
    assert (both.n_instants, both.n_left_out) == (6, 0)
    both = SynchronizedFrames([recorded(first), recorded(second)], 35, 39)
    assert [instant_of(pair[1]) for pair in both] == list(range(35, 40))
    assert (both.n_instants, both.n_missing, both.n_left_out) == (5, [0, 0], 0)
    open_end = SynchronizedFrames([recorded(range(50)), recorded(range(52))], 48)
    assert [[instant_of(frame) for frame in pair] for pair in open_end] == [[48, 48], [49, 49], [None, 50], [None, 51]]


@pytest.fixture
def films_by_time(tmp_path):
    """Two folders of pictures that are named by their times, a rig, a model and landmarks; the second lost five."""
    for k, (name, instants) in enumerate((("front", range(N)), ("aside", without(10, 5)))):
        (tmp_path / name).mkdir()
        camera = RIG[k].camera
        picture = cv2.imencode(".png", np.zeros((camera.height, camera.width, 3), np.uint8))[1].tobytes()
        for n in instants:
            (tmp_path / name / f"{EPOCH + n / RATE:.6f}.png").write_bytes(picture)
    model = bent_sheet_model(8, 6)
    save_model(tmp_path / "sheet.morph", model)
    save_rig(tmp_path / "camchain.yaml", [(part.camera, part.camera_from_rig) for part in RIG])
    write_landmarks(tmp_path / "landmarks.csv", model, sheet_state(0.0), FRONT.camera, count=24)
    return tmp_path


def options(folder, first, last):
    return md.TrackOptions(
        frames=folder / "front",
        other_cameras=(folder / "aside",),
        camera=f"{folder}/camchain.yaml#cam0",
        model=folder / "sheet.morph",
        landmarks=folder / "landmarks.csv",
        output=folder / "run",
        first=first,
        last=last,
    )


@pytest.mark.parametrize(("first", "last"), [(40, 44), (75, 78)])
def test_a_run_in_a_range_tracks_what_both_cameras_saw_at_one_time(films_by_time, first, last):
    """The second recording has frames 0 to 74, and shows instant 78 all the same."""
    with ExitStack() as stack:
        _, source, placed = prepare(options(films_by_time, first, last), stack)
        pairs = [[instant_of(frame) for frame in pair] for pair in source]
    assert placed[0].frame == first
    assert pairs == [[n, n] for n in range(first, last + 1)]


def test_a_range_that_the_first_camera_has_not_is_refused(films_by_time):
    with ExitStack() as stack, pytest.raises(md.MorphError, match="frame 80 is not in"):
        prepare(options(films_by_time, 60, 80), stack)


def test_pictures_of_a_keyframe_are_of_its_instant():
    """A strip of texture moves by five pixels an instant before both cameras."""
    noise = np.random.default_rng(0).integers(0, 255, (24, 5 * N + 32), dtype=np.uint8)
    strip = np.repeat(cv2.GaussianBlur(noise, (0, 0), 2.0)[:, :, None], 3, axis=2)

    def filmed(instants):
        return Timed(Frame(k, EPOCH + n / RATE, strip[:, 5 * n : 5 * n + 32]) for k, n in enumerate(instants))

    camera = md.Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
    recordings = SynchronizedFrames([filmed(range(N)), filmed(without(10, 5))])
    seen = images_from(recordings.of_camera(1), camera, [5, 12, 40, 60])
    assert sorted(seen) == [5, 40, 60]  # frame 12 was lost
    for number, image in seen.items():
        np.testing.assert_array_equal(image.grey, strip[:, 5 * number : 5 * number + 32, 0])


def test_numbered_pictures_of_a_keyframe_are_those_of_its_number():
    """Where numbers tell, a recording may begin within the scan."""

    class Numbered(Timed):
        has_assumed_times = True

    image = np.zeros((4, 6, 3), dtype=np.uint8)
    recordings = [Numbered(Frame(k, k / RATE, image) for k in range(first, 9)) for first in (0, 4)]
    assert [frame.index for frame in SynchronizedFrames(recordings).of_camera(1)] == [4, 5, 6, 7, 8]
