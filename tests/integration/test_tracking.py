"""The whole online chain on rendered sequences whose truth is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, CameraError, RegistrationError, SourceError, TrackingError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.binding import draw_view, view_of
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.other_tilt import mirrored_tilt
from morph_dslam.tracking.outcomes import BlurredByMotion, DepthNotUsed, KnownRefuted, ReferenceBlurred, RejectionReason
from morph_dslam.tracking.result import STAGES
from morph_dslam.tracking.session import Session
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.tracker_inputs import check_tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm, mean_error, sheet_depth, sheet_state
from tests.support.staged_scenes import aside


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


@pytest.fixture(scope="module")
def film(model):
    return SheetFilm(model)


def started_alike(model, options=None):
    """A tracker whose reference frame has the same noise each time."""
    first = sheet_state(0.0)
    return Tracker(model, CAMERA, Registration(model, first), options, reference=SheetFilm(model).frame(first))


def start(model, film, **options):
    first = sheet_state(0.0)
    return Tracker(model, CAMERA, Registration(model, first), reference=film.frame(first), **options)


def test_moving_bending_sheet_is_followed_within_a_fraction_of_a_millimetre(model, film):
    tracker = start(model, film)
    errors, deviations = [], []
    for time in np.linspace(0.0, 1.0, 31)[1:]:
        truth = sheet_state(time)
        result = tracker.track(film.frame(truth, light=1.0 - 0.25 * time))
        assert result.status == "tracked", result.reason
        errors.append(mean_error(model, result.estimate.state, truth))
        deviations.append(np.abs(result.estimate.state.parameters - truth.parameters) / result.estimate.parameter_std)
        assert set(result.timings_ms) == set(STAGES)
    assert np.mean(errors) < 0.15e-3
    assert errors[-1] < 0.3e-3  # nothing has accumulated
    # The stated deviations are of the right size (systematic errors of the matching come on top).
    assert np.median(deviations) < 4.0


@pytest.mark.parametrize("distance", [1.2, 2.0])
def test_a_tilt_that_was_taken_for_its_mirror_image_is_left(distance):
    """From afar a flat object that is tilted to either side looks nearly the same: it stayed 115 mm off."""
    model = bent_sheet_model(22, 16)
    film = SheetFilm(model)

    def state(number):
        turn = rotation_exp(np.array([0.1, 0.5 + 0.02 * number, 0.1 * number])) @ UPRIGHT
        parameters = np.array([0.02 + 0.005 * number, 0.1, 0.05])
        return State(parameters, RigidTransform(turn, np.array([0.01 * number, 0.0, distance])))

    tracker = Tracker(model, CAMERA, Registration(model, state(0)), reference=film.frame(state(0)))
    found = tracker.track(film.frame(state(1))).estimate.state
    wrong = mirrored_tilt(model.positions(found.parameters), found.camera_from_object)
    tracker.continue_from(replace(found, camera_from_object=wrong))
    assert mean_error(model, tracker.state, state(1)) > 50e-3
    for number in range(2, 5):
        result = tracker.track(film.frame(state(number)))
        assert mean_error(model, result.estimate.state, state(number)) < 8e-3


def test_points_behind_an_occluder_are_rejected_and_come_back(model, film):
    tracker = start(model, film)
    counts = {}
    for step, time in enumerate(np.linspace(0.0, 0.5, 16)[1:]):
        truth = sheet_state(time)
        hand = (60 + 25 * step, 140, 150, 240) if 3 <= step <= 9 else None
        result = tracker.track(film.frame(truth, occluder=hand))
        assert result.status == "tracked", result.reason
        assert mean_error(model, result.estimate.state, truth) < 1.5e-3
        counts[step] = result.n_inliers
    assert min(counts[step] for step in range(3, 10)) < 0.85 * counts[2]
    assert counts[14] > 0.9 * counts[2]


def test_what_moves_farther_than_it_is_followed_is_found_whole_and_not_said_to_be_covered(model):
    """Fine speckles on a sheet that snaps through in a pose that holds: most of its points go 30 pixels and more."""
    film = SheetFilm(model)
    speckles = cv2.GaussianBlur(np.random.default_rng(5).standard_normal(film.texture.shape), (0, 0), 2.5)
    film.texture = np.clip(128.0 + 60.0 * speckles / speckles.std(), 0.0, 255.0).astype(np.uint8)
    pose = RigidTransform(rotation_exp(np.array([0.6, -0.15, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.65]))
    heights = [0.0, 0.0, 0.025, 0.05, 0.03, -0.01, 0.05, -0.05]
    arched = [State(np.array([height, 0.0, 0.0]), pose) for height in heights]
    known = Registration(model, arched[0])
    tracker = Tracker(model, CAMERA, known, TrackerOptions(pose="still"), reference=film.frame(arched[0]))
    for truth in arched:
        result = tracker.track(film.frame(truth))
        assert (result.status, result.warnings) == ("tracked", ())
        assert result.n_inliers > 0.9 * result.n_points
        assert mean_error(model, result.estimate.state, truth) < 0.1e-3


def test_a_frame_that_motion_blurs_is_named_and_its_deviations_hold_the_error(model, film):
    """Two frames in which the sheet goes on by about ten pixels, three quarters of them while the shutter is open."""
    times = np.concatenate([np.linspace(0.0, 0.05, 6), [0.12, 0.19], np.linspace(0.191, 0.21, 5)])
    blurred, tracker = {6, 7}, start(model, film)
    for number, time in enumerate(times[1:], start=1):
        exposure = 0.75 * 0.07 * np.linspace(-0.5, 0.5, 15) if number in blurred else np.zeros(1)
        frame = np.mean([film.frame(sheet_state(time + part), noise=0.0) for part in exposure], axis=0)
        result = tracker.track((frame + film.rng.normal(0.0, 2.0, frame.shape)).clip(0, 255).astype(np.uint8))
        assert result.status == "tracked", result.reason
        warning, truth, found = result.warning(BlurredByMotion), sheet_state(time), result.estimate
        assert (warning is not None) == (number in blurred)
        if warning is not None:
            points = [
                CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))
                for state in (sheet_state(time + exposure[0]), sheet_state(time + exposure[-1]))
            ]
            path = np.sqrt(np.mean(np.sum((points[1] - points[0]) ** 2, axis=1)))
            assert 0.5 * path < warning.path_px < 2.0 * path
            assert (np.abs(found.state.parameters - truth.parameters) < 3.0 * found.parameter_std).all()
            apart = found.state.camera_from_object.translation - truth.camera_from_object.translation
            assert (np.abs(apart) < 3.0 * np.sqrt(np.diag(found.covariance)[-3:])).all()


@pytest.mark.parametrize("is_blurred", [True, False])
def test_a_reference_picture_that_motion_blurs_is_named_by_sharp_frames(model, film, is_blurred):
    """The sheet goes on by about ten pixels in the frame after the reference frame, and then slowly."""
    exposure = 0.06 * np.linspace(-0.5, 0.5, 15) if is_blurred else np.zeros(1)
    first = np.mean([film.frame(sheet_state(0.1 + part), noise=0.0) for part in exposure], axis=0)
    tracker = Tracker(model, CAMERA, Registration(model, sheet_state(0.1)), reference=first.astype(np.uint8))
    named = []
    for time in [0.1, 0.17, 0.172, 0.174, 0.176]:
        frame = first.astype(np.uint8) if time == 0.1 else film.frame(sheet_state(time))
        result = tracker.track(frame)
        assert result.status == "tracked", result.reason
        assert result.warning(BlurredByMotion) is None
        named.append(result.warning(ReferenceBlurred) is not None)
    assert any(named) == is_blurred


def test_lost_object_says_why_and_is_recovered_elsewhere(model, film):
    tracker = start(model, film)
    assert tracker.track(film.frame(sheet_state(0.03))).status == "tracked"
    for _ in range(2):
        result = tracker.track(film.blank())
        assert result.status == "lost"
        assert result.estimate is None
        assert (result.rejection.reason, result.rejection.needed) == (RejectionReason.FEW_POINTS, 30)
    away = sheet_state(0.2)
    moved = RigidTransform(
        rotation_exp(np.array([0.0, 0.0, 0.4])) @ away.camera_from_object.rotation,
        away.camera_from_object.translation + np.array([-0.05, 0.04, 0.1]),
    )
    truth = State(away.parameters, moved)
    result = tracker.track(film.frame(truth))
    assert result.status == "tracked", result.reason
    assert result.recovered
    assert mean_error(model, result.estimate.state, truth) < 1.5e-3
    result = tracker.track(film.frame(aside(truth, [0.004, 0.0, 0.0])))
    assert (result.status, result.recovered) == ("tracked", False)


def test_what_is_known_still_counts_after_frames_without_the_object(model, film):
    """No point is seen in a black frame or under a full mask, and the sensor goes on all the while."""
    tracker, sensor_std = start(model, film), 2e-4
    for time in (0.02, 0.04):
        tracker.track(film.frame(sheet_state(time)))
    black, everywhere = np.zeros_like(film.blank()), np.ones(film.blank().shape[:2], dtype=bool)
    for time, hidden in ((0.06, black), (0.10, None)):
        tracker.know({"arch": (sheet_state(time).parameters[0], sensor_std)})
        picture = film.frame(sheet_state(time)) if hidden is None else hidden
        assert tracker.track(picture, occluder_depth=everywhere if hidden is None else None).status == "lost"
        for later in (time + 0.01, time + 0.02):
            truth = sheet_state(later)
            tracker.know({"arch": (truth.parameters[0], sensor_std)})
            result = tracker.track(film.frame(truth))
            assert result.status == "tracked", result.reason
            assert result.estimate.state.parameters[0] == pytest.approx(truth.parameters[0], abs=3.0 * sensor_std)
            assert mean_error(model, result.estimate.state, truth) < 0.5e-3
            assert result.estimate.parameter_std[0] < 1.5 * sensor_std


def test_where_a_clock_tells_the_time_other_deviations_have_the_mesh_error_of_a_known_time(model):
    """In the certificate a time that may change leaves much of another parameter open, in proportion to the size."""
    film = SheetFilm(model)
    arch, *others = model.parameters
    time = Parameter(arch.name, "time", "s", arch.lower, arch.upper, arch.default)
    slopes = model.displacement.value_and_sensitivities(sheet_state(0.1).parameters)[1][:, np.unique(model.triangles)]
    square = float(np.mean(np.sum(slopes[1] ** 2, axis=1)))
    # What 1e-5 of the time moves, 499 times as much of the other parameter does.
    products = square * np.array([[1e6, -499.0], [-499.0, 1.0]])
    stated = {"errors": {arch.name: [1e-5], others[0].name: [5e-3]}, "displacement_rms_mm": [1.0], "left_rms_mm": [0.0]}
    stated["products_m2"] = [products.tolist()]
    timed = replace(model, parameters=(time, *others), certificate={"discretisation": {"parameters": stated}})
    deviations = []
    for known in (False, True):
        tracker, truth = start(timed, film), sheet_state(0.1)
        if known:
            tracker.know({arch.name: (truth.parameters[0], 1e-5)})
        deviations.append(tracker.track(film.frame(truth)).estimate.parameter_std[1])
    size = 1e3 * np.sqrt(np.mean(np.sum((model.positions(truth.parameters) - model.nodes) ** 2, axis=1)))
    assert deviations[0] == pytest.approx(5e-3 * size, rel=0.1)
    assert deviations[1] < 0.1 * deviations[0]


@pytest.mark.parametrize("sensor_std", [2e-3, 2e-5])
def test_a_sensor_that_the_images_refute_is_named_and_a_right_one_is_not(model, film, sensor_std):
    """Its readings are right at first, with noise of the stated size, and have another zero later."""
    tracker, random, refuted = start(model, film), np.random.default_rng(2), []
    for number, time in enumerate(np.linspace(0.0, 0.4, 25)[1:]):
        truth, zero = sheet_state(time).parameters[0], 0.015 if number >= 16 else 0.0
        tracker.know({"arch": (truth + zero + sensor_std * random.standard_normal(), sensor_std)})
        result = tracker.track(film.frame(sheet_state(time)))
        assert result.tracked, result.reason
        found = [warning for warning in result.warnings if isinstance(warning, KnownRefuted)]
        refuted.append(len(found))
        for warning in found:
            assert (warning.parameter, warning.deviations > 4.0) == ("arch", True)
            assert float(warning.found.removesuffix(" mm")) == pytest.approx(1e3 * truth, abs=1.0)
    assert refuted == [0] * 16 + [1] * 8
    # The blame for what the sensor does not fit is not laid on the registration.
    assert result.reference_factor == pytest.approx(1.0, abs=0.1)


def test_lens_distortion_is_undone(model):
    """Frames warped by a lens give the same states as ideal ones."""
    lens = Camera(640, 480, 528.0, 528.0, 320.0, 240.0, (-0.15, 0.05, 0.001, -0.001))
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    ideal = lens.undistort_pixels(np.column_stack([columns.ravel(), rows.ravel()]))
    maps = ideal.reshape(480, 640, 2).astype(np.float32)
    film = SheetFilm(model)

    def recorded(state):
        return cv2.remap(film.frame(state, noise=0.0), maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)

    tracker = Tracker(model, lens, Registration(model, sheet_state(0.0)), reference=recorded(sheet_state(0.0)))
    for time in (0.03, 0.06, 0.09):
        result = tracker.track(recorded(sheet_state(time)))
        assert result.status == "tracked"
    assert mean_error(model, result.estimate.state, sheet_state(0.09)) < 0.6e-3


def test_sequence_that_does_not_begin_at_the_reference_is_entered(model, film):
    tracker, truth = start(model, film, in_sequence=False), sheet_state(0.5)
    result = tracker.track(film.frame(truth))
    assert result.status == "tracked", result.reason
    assert mean_error(model, result.estimate.state, truth) < 1.5e-3


def test_object_without_texture_is_refused_with_advice(model, film):
    with pytest.raises(RegistrationError, match="printed texture"):
        Tracker(model, CAMERA, Registration(model, sheet_state(0.0)), reference=film.blank(noise=0.0))


def test_a_grey_picture_is_as_good_as_a_grey_one_in_colour(model):
    picture, found = SheetFilm(model).frame(sheet_state(0.03)), []
    for seen in (picture, picture[..., 0], picture[..., :1], Frame(1, 0.03, picture[..., 0])):
        found.append(started_alike(model).track(seen).estimate.state.parameters)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_frames_that_are_none_are_refused(model):
    tracker, picture = started_alike(model), SheetFilm(model).frame(sheet_state(0.03))
    depth = np.full(picture.shape[:2], 0.6, np.float32)
    for wrong in (None, picture.astype(float), picture[:100], Frame(3, 0.1, None), Frame(3, 0.1, picture[..., :2])):
        with pytest.raises(CameraError, match="frame"):
            tracker.track(wrong)
    with pytest.raises(SourceError, match="frame 3 has no timestamp"):
        tracker.track(Frame(3, None, picture))
    for time in (np.nan, "0.1", np.datetime64("2026-01-01T12:00:00.1"), 1_796_000_000_000_000_000, 1.796e12):
        with pytest.raises(SourceError, match=r"frame 3 has the timestamp .* seconds"):
            tracker.track(Frame(3, time, picture))
    with_depth = started_alike(model, TrackerOptions(use_depth=True))
    for wrong in ((1e3 * depth).astype(np.uint16), depth[::2, ::2], depth[..., None], [0.6]):
        with pytest.raises(CameraError, match=r"the depth of frame 3 is .*metres as float32"):
            with_depth.track(Frame(3, 0.1, picture, wrong))
    assert tracker.track(Frame(3, 0.1, picture, depth.astype(np.uint16))).tracked  # nobody asks for it
    assert with_depth.track(Frame(3, 0.1, picture, depth)).tracked


@pytest.mark.parametrize(("factor", "ratio"), [(1.0, None), (1e3, 1e3), (0.1, 0.1), (np.nan, None)])
def test_depth_that_puts_the_object_elsewhere_does_not_count_and_that_is_said(model, factor, ratio):
    truth = sheet_state(0.03)
    depth = np.float32(factor) * sheet_depth(model, truth, np.random.default_rng(0))
    frame = Frame(1, 0.03, SheetFilm(model).frame(truth), depth)
    with_depth = started_alike(model, TrackerOptions(use_depth=True)).track(frame)
    without = started_alike(model).track(frame)
    warning = with_depth.warning(DepthNotUsed)
    if factor == 1.0:
        assert warning is None
        assert with_depth.parameters != without.parameters
    else:
        assert warning.ratio == (ratio and pytest.approx(ratio, rel=0.01))
        assert with_depth.parameters == without.parameters


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("notch.morph", CAMERA, None), "load_model"),
        ((None, "camera.yaml", None), "model"),
        (("model", "camera.yaml", "registration"), "load_camera"),
        (("model", CAMERA, "landmarks.csv"), "register_landmarks"),
        (("model", CAMERA, None), "register_landmarks"),
        (("model", CAMERA, "registration", "fast"), "TrackerOptions"),
    ],
)
def test_arguments_of_another_kind_are_named(model, arguments, named):
    known = {"model": model, "registration": Registration(model, sheet_state(0.0))}
    with pytest.raises(ArgumentError, match=named):
        Tracker(*(known.get(one, one) if isinstance(one, str) else one for one in arguments))


def test_a_registration_of_another_object_is_refused(model):
    known = Registration(model, sheet_state(0.0))
    finer, other = bent_sheet_model(45, 31), replace(model, nodes=1.01 * model.nodes)
    fewer = replace(model, parameters=(*model.parameters[:-1], replace(model.parameters[-1], name="twirl")))
    for wrong, said in (
        (finer, r"its mesh has 1333 nodes, and the model's 1395"),
        (other, rf"nodes of its mesh are up to {10.0 * np.hypot(0.21, 0.1485):.3g} mm from"),
        (fewer, "its parameters are arch, skew, twist, and the model's arch, skew, twirl"),
    ):
        with pytest.raises(ArgumentError, match=said):
            Tracker(wrong, CAMERA, known)
        with pytest.raises(ArgumentError, match=said):
            RigTracker(wrong, [], known, references=[])
    # The same mesh from a file; and an angle that was left open, which the registration's model alone has.
    again = replace(model, name="again", nodes=model.nodes.astype(np.float32).astype(np.float64))
    check_tracker(again, known, None)
    turning = replace(model, parameters=(*model.parameters, replace(model.parameters[-1], name="turn")))
    check_tracker(model, replace(known, model=turning, per_sequence=("turn",)), None)
    with pytest.raises(ArgumentError, match="arch, skew, twist, turn, and the model's arch, skew, twist;"):
        check_tracker(model, replace(known, model=turning), None)


def test_before_its_first_frame_a_tracker_is_where_the_registration_has_it(model, film):
    """Or where it is told to go on from: the reference view is of the registration all the same."""
    first, other = sheet_state(0.0), sheet_state(0.02)
    tracker = Tracker(model, CAMERA, Registration(model, first))
    assert tracker.state is first
    tracker.continue_from(other)
    assert tracker.state is other
    result = tracker.track(film.frame(first))
    assert result.tracked, result.reason
    assert mean_error(model, result.estimate.state, first) < 0.3e-3
    np.testing.assert_allclose(tracker.reference.pixels, CAMERA.project(tracker.reference.points.in_camera(first)))


def test_a_pose_is_held_fixed_by_a_map(model):
    with pytest.raises(TrackingError, match="held fixed by a map"):
        Tracker(model, CAMERA, Registration(model, sheet_state(0.0)), TrackerOptions(pose="fixed"))


def test_a_session_takes_trackers_by_name_frames_and_a_list_of_sinks(model):
    tracker = started_alike(model)
    with pytest.raises(ArgumentError, match="by its name"):
        Session(tracker, [])
    with pytest.raises(ArgumentError, match=r"source is None: give frames"):
        Session({"sheet": tracker}, None)
    for sinks in (print, [print, "video"]):
        with pytest.raises(ArgumentError, match=r"a list of functions .*\[results.append\]"):
            Session({"sheet": tracker}, [], sinks)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("second", "message"),
    [
        (lambda image: Frame(3, 0.1, image), "the session's source gives frame 3 after frame 3: number frames"),
        (lambda image: Frame(1, 0.1, image), "gives frame 1 after frame 3"),
        (lambda image: (Frame(4, 0.1, image), Frame(3, 0.1, image)), "gives frame 3 after frame 3"),
        (lambda image: image, "an object of type ndarray after frame 3: give md.Frame objects"),
    ],
)
def test_a_session_takes_frames_in_their_order(model, film, second, message):
    """The frame before the wrong one is handed out."""
    image, results = film.frame(sheet_state(0.01)), []
    with pytest.raises(SourceError, match=message):
        Session({"sheet": started_alike(model)}, [Frame(3, 0.0, image), second(image)], [results.append]).run()
    assert [tracked.frame.index for tracked in results] == [3]


def test_same_frames_give_the_same_states(model):
    runs = []
    for _ in range(2):
        film = SheetFilm(model, seed=3)
        tracker = start(model, film)
        states = [tracker.track(film.frame(sheet_state(t))).estimate.state for t in (0.03, 0.06)]
        runs.append(np.array([state.parameters for state in states]))
    np.testing.assert_array_equal(*runs)


def test_covered_object_is_lost_and_never_put_elsewhere(model):
    """A board is pushed over all of the object, stays, and is drawn away again."""
    film = SheetFilm(model)  # its own noise: of frames just covered, two in a hundred are off by more than this
    tracker = start(model, film)
    shares = [0.3, 0.6, 0.9, 1.0, 1.0, 1.0, 1.0, 0.9, 0.6, 0.3, 0.0]
    seen = []
    for step, share in enumerate(shares):
        truth = sheet_state(0.01 * step)
        board = (0, 0, int(640 * share), 480) if share else None
        result = tracker.track(film.frame(truth, occluder=board))
        seen.append(result.status == "tracked")
        if result.estimate is None:
            assert result.rejection.reason is RejectionReason.FEW_POINTS
        else:
            # Of a third of the object the shape of the rest is not known well, and that is said.
            found, pose = result.estimate.state, result.estimate.state.camera_from_object
            off = np.abs(found.parameters - truth.parameters) / result.estimate.parameter_std
            away = np.abs(pose.translation - truth.camera_from_object.translation)
            assert off.max() < 5.0
            assert (away / result.estimate.pose_std[3:]).max() < 5.0
    assert mean_error(model, result.estimate.state, truth) < 0.5e-3
    assert not any(seen[2:8])
    assert seen[0]
    assert seen[-1]


def test_object_absent_from_the_beginning_is_waited_for(model, film):
    """Another print on a sheet of the same shape is not the object either."""
    tracker, truth = start(model, film, in_sequence=False), sheet_state(0.1)
    for frame in (film.blank(), SheetFilm(model, seed=9).frame(truth), film.blank()):
        result = tracker.track(frame)
        assert (result.status, result.estimate) == ("lost", None)
        assert result.rejection.then.reason is RejectionReason.FEW_FEATURES
    result = tracker.track(film.frame(truth))
    assert result.status == "tracked", result.reason
    assert mean_error(model, result.estimate.state, truth) < 1.5e-3


def jumps(count):
    """States far from the first one: other shapes, turned by about 20 degrees, moved by about 7 cm."""
    random = np.random.default_rng(0)
    for _ in range(count):
        shape = sheet_state(random.uniform(0.2, 1.0))
        turn, shift = 0.25 * random.normal(size=3), random.normal(size=3) * [0.05, 0.04, 0.05]
        pose = shape.camera_from_object
        moved = RigidTransform(rotation_exp(turn) @ pose.rotation, pose.translation + shift)
        yield State(shape.parameters, moved)


def test_object_that_moved_in_a_gap_of_the_recording_is_looked_for_anew(model, film):
    for truth in jumps(5):
        tracker = start(model, film)
        for i in range(3):
            tracker.track(Frame(i, i / 30, film.frame(sheet_state(0.02 * i))))
        first, second = (tracker.track(Frame(3 + i, 3.0 + i / 30, film.frame(truth))) for i in range(2))
        assert first.recovered
        assert mean_error(model, first.estimate.state, truth) < 2e-3
        assert mean_error(model, second.estimate.state, truth) < 0.1e-3


def test_second_identical_object_is_not_taken_for_the_first(model, film):
    """Followed, the object stays what it is; after a loss two that look the same cannot be told apart."""
    here = aside(sheet_state(0.0), [-0.16, 0.0, 0.55])
    there = aside(here, [0.42, 0.08, 0.0])
    tracker = Tracker(model, CAMERA, Registration(model, here), reference=film.frame(here))

    def both(first, second):
        image, other = film.frame(first), film.frame(second)
        view = view_of(model, CAMERA, second)
        covered = draw_view(view, model.triangles, CAMERA).covered
        return np.where(covered[:, :, None], other, image)

    for step in range(3):
        moved = aside(here, [0.002 * step, 0.0, 0.0])
        result = tracker.track(both(moved, there))
        assert result.status == "tracked"
        assert mean_error(model, result.estimate.state, moved) < 1e-3
    assert tracker.track(film.blank()).status == "lost"
    changed = aside(here, [0.0, -0.05, 0.0]), aside(there, [0.0, 0.04, 0.0])
    result = tracker.track(both(*changed))
    assert (result.status, result.estimate) == ("lost", None)
    assert result.rejection.then.reason is RejectionReason.TWO_PLACES
    # With one of them gone there is no doubt.
    result = tracker.track(film.frame(changed[1]))
    assert result.status == "tracked", result.reason
    assert mean_error(model, result.estimate.state, changed[1]) < 1.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("moved_mm", [12.0, 37.0, 70.0])
def test_a_regular_print_is_not_found_a_period_off(model, moved_mm):
    """Dots are 35 mm apart. While it is hidden the sheet moves by about as much, or by two of that."""
    film = SheetFilm(model)
    rows, columns = np.indices((594, 840)) % 70 - 35
    film.texture = 60.0 + 140.0 * (np.hypot(rows, columns) < 18)
    tracker = start(model, film)
    for step in range(3):
        assert tracker.track(film.frame(sheet_state(0.01 * step))).status == "tracked"
    assert tracker.track(film.blank()).status == "lost"
    errors = []
    for step in range(4):
        truth = aside(sheet_state(0.03 + 0.01 * step), [1e-3 * moved_mm, 0.0, 0.0])
        result = tracker.track(film.frame(truth))
        if result.estimate is not None:
            errors.append(mean_error(model, result.estimate.state, truth))
    assert errors
    assert max(errors) < 1e-3


def with_disc(image, step):
    """The image (h, w, 3) with a striped disc that goes round over its middle."""
    turn, along = 2.0 * np.pi * step / 15, np.indices(image.shape[:2]).sum(axis=0)
    centre = (int(320 + 70 * np.cos(turn)), int(240 + 45 * np.sin(turn)))
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.circle(mask, centre, 120, 255, -1, cv2.LINE_AA)
    stripes = (150 + 40 * np.sin(0.35 * along - 0.9 * step))[:, :, None]
    share = mask[:, :, None] / 255.0
    return np.clip((1.0 - share) * image + share * stripes, 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_errors_of_an_object_that_stays_as_in_the_reference_view_are_as_large_as_stated(model):
    """All that differs from frame to frame is noise; what the reference picture has of it stays with the points."""
    truth, off = sheet_state(0.0), []
    for seed in range(6):
        film = SheetFilm(model, seed=seed)
        tracker = start(model, film)
        for _ in range(15):
            estimate = tracker.track(film.frame(truth)).estimate
            off.append((estimate.state.parameters - truth.parameters) / estimate.parameter_std)
    # Whole grey levels of the rendered reference view made it 1.3. Enlarging the picture smooths its own noise.
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.2


@pytest.fixture(scope="module")
def covered_run(model):
    """Mean errors by frame, mm, errors of the parameters over their deviations, and points that agreed."""
    film = SheetFilm(model)
    tracker = start(model, film)
    errors, normalised, counts = [], [], []
    for step, time in enumerate(np.linspace(0.0, 0.6, 36)[1:]):
        truth = sheet_state(time)
        result = tracker.track(with_disc(film.frame(truth), step))
        assert result.status == "tracked", (step, result.reason)
        errors.append(1e3 * mean_error(model, result.estimate.state, truth))
        off = result.estimate.state.parameters - truth.parameters
        normalised.append(np.abs(off) / result.estimate.parameter_std)
        counts.append(result.n_inliers / len(tracker.reference.points))
    return np.array(errors), np.array(normalised), np.array(counts)


def test_windows_at_the_rim_do_not_spoil_what_the_others_tell(covered_run):
    """With the same weight for all points the errors are 0.38 mm on average and 0.23 in the median.

    Of other films the median is 0.05 to 0.1 mm.
    """
    errors, _, share = covered_run
    assert 0.3 < share.mean() < 0.6
    assert errors.mean() < 0.15
    assert np.median(errors) < 0.12


def test_errors_are_as_large_as_stated(covered_run):
    """95 % of Gaussian errors are below 1.96."""
    _, normalised, _ = covered_run
    assert 1.5 < np.quantile(normalised, 0.95) < 2.6
