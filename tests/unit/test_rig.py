"""Several cameras in one estimate, and the error of their reference state: differences, spreads, predictions."""

from dataclasses import replace
from functools import reduce
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.linalg import sqrtm

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, TrackingError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.camera_files import load_rig
from morph_dslam.model import SurfacePoints
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator, Prior, State, moved
from morph_dslam.tracking.multi_camera import RigTracker, agreeing
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.reference_correction import ReferenceCorrection
from morph_dslam.tracking.rig import RigCamera, RigEstimator
from morph_dslam.tracking.rig_errors import RigErrors
from morph_dslam.tracking.sequence_filter import SequenceFilter
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import measured
from tests.support.rendered_sequence import CAMERA, sheet_state

MODEL = bent_sheet_model(22, 16)
LEFT = RigCamera(Camera(640, 480, 528.0, 528.0, 320.0, 240.0), RigidTransform.identity())
#: Half a metre to the right, turned towards the object, of another make.
ASIDE = RigCamera(
    Camera(800, 600, 700.0, 690.0, 400.0, 290.0),
    RigidTransform(rotation_exp(np.array([0.05, 0.7, -0.1])), np.array([-0.45, 0.02, 0.15])),
)
TRUTH = State(
    np.array([0.035, 0.3, 0.1]),
    RigidTransform(rotation_exp(np.array([0.2, -0.3, 0.05])) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.6])),
)
SIGMA = 0.4


def bound(count, seed, columns=(-1.0, 1.0)):
    """Points between two shares of the sheet's half length."""
    rng = np.random.default_rng(seed)
    x = MODEL.nodes[MODEL.triangles, 0].mean(axis=1) / 0.21
    inside = np.flatnonzero((x > columns[0]) & (x < columns[1]))
    surface = SurfacePoints(rng.choice(inside, count), rng.dirichlet(np.ones(3), count))
    return BoundPoints.from_surface(MODEL, surface)


def seen_by(part, points, rng, sigma=SIGMA):
    pixels = part.camera.project(points.in_camera(part.seen(TRUTH)))
    return measured(points, pixels + sigma * rng.standard_normal(pixels.shape))


def test_a_pose_known_in_the_rig_is_known_as_well_in_each_camera():
    """How errors in the rig's frame appear in a camera's is found by making them."""
    rng = np.random.default_rng(4)
    root, lasting = rng.normal(size=(6, 6)) * 1e-3, rng.normal(size=(6, 2)) * 1e-3
    pose = TRUTH.camera_from_object
    seen = ASIDE.seen_pose(PosePrior(pose, root @ root.T, lasting))
    np.testing.assert_allclose(seen.pose.matrix, ASIDE.seen(TRUTH).camera_from_object.matrix, atol=1e-12)

    def in_camera(error):
        wrong = moved(TRUTH, np.concatenate([np.zeros(3), error]))
        return seen.away(ASIDE.seen(wrong).camera_from_object)

    made = np.column_stack([in_camera(error) for error in root.T])
    np.testing.assert_allclose(seen.from_camera, made @ made.T, atol=1e-12)
    made = np.column_stack([in_camera(error) for error in lasting.T])
    np.testing.assert_allclose(seen.lasting, made, atol=1e-12)


def test_gradient_and_cost_are_those_of_all_cameras():
    rng = np.random.default_rng(0)
    views = RigObservations((seen_by(LEFT, bound(40, 0), rng), seen_by(ASIDE, bound(50, 1), rng)))
    estimator = RigEstimator(MODEL, [LEFT, ASIDE])
    state = moved(TRUTH, np.full(9, 3e-3))
    cost, hessian, gradient, residuals = estimator.evaluate(views, state)
    by_hand = 0.0
    for part, view in zip((LEFT, ASIDE), views.views, strict=True):
        length = np.linalg.norm(part.camera.project(view.points.in_camera(part.seen(state))) - view.pixels, axis=1)
        by_hand += np.sum(np.where(length <= 3.0, 0.5 * length**2, 3.0 * (length - 1.5)))
    assert cost == pytest.approx(by_hand)
    assert residuals.shape == (90, 2)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9)
    for k, unit in enumerate(np.eye(9)):
        ends = [estimator.evaluate(views, moved(state, sign * 1e-7 * unit))[0] for sign in (1.0, -1.0)]
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-7, rel=1e-4, abs=1e-2)


def test_one_camera_in_a_rig_is_that_camera():
    view = seen_by(LEFT, bound(60, 2), np.random.default_rng(2))
    alone = Estimator(MODEL, LEFT.camera).fit(view, TRUTH)
    rig = RigEstimator(MODEL, [LEFT]).fit(RigObservations((view,)), TRUTH)
    np.testing.assert_allclose(rig.state.parameters, alone.state.parameters, rtol=1e-9)
    np.testing.assert_allclose(rig.covariance, alone.covariance, rtol=1e-6)


def test_both_cameras_are_better_than_one_and_deviations_say_so():
    """Repeated measurements of a camera in front and one aside."""
    points = bound(60, 3), bound(60, 4)
    estimators = {"left": Estimator(MODEL, LEFT.camera), "rig": RigEstimator(MODEL, [LEFT, ASIDE])}
    found, stated = {"left": [], "rig": []}, {"left": [], "rig": []}
    for seed in range(80):
        rng = np.random.default_rng(seed)
        views = seen_by(LEFT, points[0], rng), seen_by(ASIDE, points[1], rng)
        for name, seen in (("left", views[0]), ("rig", RigObservations(views))):
            estimator = estimators[name]
            estimate = SequenceFilter(estimator, []).fuse(seen, estimator.fit(seen, TRUTH))
            found[name].append([*estimate.state.parameters, *estimate.state.camera_from_object.translation])
            stated[name].append([*estimate.parameter_std, *estimate.pose_std[3:]])
    spread = {name: np.std(values, axis=0) for name, values in found.items()}
    assert (spread["rig"] < 0.75 * spread["left"]).all()
    assert spread["rig"][5] < 0.5 * spread["left"][5]
    for name in ("left", "rig"):
        np.testing.assert_allclose(np.mean(stated[name], axis=0), spread[name], rtol=0.3)


def test_what_one_camera_cannot_see_is_seen_by_the_other():
    """The left camera sees the middle of the sheet, where the skew has hardly any effect."""
    rng = np.random.default_rng(5)
    middle, end = seen_by(LEFT, bound(60, 5, (-0.1, 0.1)), rng), seen_by(ASIDE, bound(60, 6, (0.2, 1.0)), rng)
    alone = Estimator(MODEL, LEFT.camera).fit(middle, TRUTH)
    rig = RigEstimator(MODEL, [LEFT, ASIDE]).fit(RigObservations((middle, end)), TRUTH)
    half = 0.5 * (MODEL.upper - MODEL.lower)
    assert alone.parameter_std[1] > half[1]
    assert (rig.parameter_std < 0.3 * half).all()
    np.testing.assert_allclose(rig.state.parameters, TRUTH.parameters, atol=4.0 * rig.parameter_std.max())


def test_parameter_over_the_sequence_sharpens_with_a_rig():
    points, estimator = (bound(30, 7), bound(30, 8)), RigEstimator(MODEL, [LEFT, ASIDE])
    filtered, deviations = SequenceFilter(estimator, [2]), []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        seen = RigObservations((seen_by(LEFT, points[0], rng), seen_by(ASIDE, points[1], rng)))
        estimate = filtered.fuse(seen, estimator.fit(seen, TRUTH))
        deviations.append(estimate.parameter_std[2])
    assert deviations[-1] == pytest.approx(deviations[0] / 4.0, rel=0.35)
    assert abs(estimate.state.parameters[2] - TRUTH.parameters[2]) < 4.0 * deviations[-1]


def test_what_a_sensor_tells_of_a_parameter_counts_once_for_all_cameras():
    """As the formula of a linear update of mean and covariance has it, of what the cameras give without it."""
    rng = np.random.default_rng(11)
    seen = RigObservations((seen_by(LEFT, bound(60, 10), rng), seen_by(ASIDE, bound(60, 11), rng)))
    estimator = RigEstimator(MODEL, [LEFT, ASIDE])
    images = SequenceFilter(estimator, []).fuse(seen, estimator.fit(seen, TRUTH))
    own = images.parameter_std[1]
    told, deviation = images.state.parameters[1] + own, own
    estimator.known.tell({MODEL.parameters[1].name: (told, deviation)})
    estimator.known.learn(SIGMA)
    both = SequenceFilter(estimator, []).fuse(seen, estimator.fit(seen, TRUTH))
    gain = images.covariance[:, 1] / (own**2 + deviation**2)
    expected = images.covariance - np.outer(gain, images.covariance[1])
    np.testing.assert_allclose(both.parameter_std, np.sqrt(np.diag(expected)[:3]), rtol=0.1)
    step = both.state.parameters - images.state.parameters
    assert (np.abs(step - gain[:3] * own) < 0.1 * images.parameter_std).all()
    assert both.parameter_std[1] == pytest.approx(own / np.sqrt(2.0), rel=0.1)


def test_the_depth_of_a_point_that_does_not_agree_does_not_count():
    """What is before a third of the points, two centimetres nearer, moves them in the image and has its own depth."""
    rng, points = np.random.default_rng(13), bound(60, 12)
    before, std = np.arange(60) % 3 == 0, 1e-3
    seen = seen_by(LEFT, points, rng)
    depths = points.in_camera(TRUTH)[:, 2] + std * rng.standard_normal(60) - np.where(before, 0.02, 0.0)
    measured_depths = PointDepths(depths, np.full(60, SIGMA / std), SIGMA**2, 50.0 * SIGMA)
    seen = replace(seen, pixels=seen.pixels + np.where(before, 30.0, 0.0)[:, None], depths=measured_depths)
    other = seen_by(ASIDE, bound(60, 14), rng)
    pixels = [part.camera.project(v.points.in_camera(part.seen(TRUTH))) for part, v in ((LEFT, seen), (ASIDE, other))]
    kept = agreeing(RigObservations((seen, other)), np.concatenate(pixels) - [*seen.pixels, *other.pixels], 3.0)
    assert [int((view.weights > 0.0).sum()) for view in kept.views] == [40, 60]
    found = RigEstimator(MODEL, [LEFT, ASIDE]).fit(kept, TRUTH)
    off = found.state.camera_from_object.translation - TRUTH.camera_from_object.translation
    assert (np.abs(off) < 3.0 * found.pose_std[3:]).all()


def test_prior_of_the_pose_is_in_the_rigs_frame():
    seen = RigObservations((seen_by(ASIDE, bound(60, 9), np.random.default_rng(9)),))
    pose = moved(TRUTH, np.full(9, 0.01)).camera_from_object
    prior = Prior(np.zeros(3), np.zeros((3, 3)), pose, 1e12 * np.eye(6))
    found = RigEstimator(MODEL, [ASIDE]).fit(seen, TRUTH, prior)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, pose.matrix, atol=1e-6)


def camchain(path, poses):
    """A camchain whose camera n + 1 is at ``poses[n]`` in the frame of camera n."""
    camera = {"camera_model": "pinhole", "intrinsics": [500.0, 500.0, 320.0, 240.0], "resolution": [640, 480]}
    camera |= {"distortion_model": "none", "distortion_coeffs": []}
    chain = {f"cam{n}": dict(camera) for n in range(len(poses) + 1)}
    for number, pose in enumerate(poses, 1):
        chain[f"cam{number}"]["T_cn_cnm1"] = pose.matrix.tolist()
    path.write_text(yaml.safe_dump(chain))


def test_camchain_gives_every_camera_in_the_frame_of_the_first(tmp_path):
    first = RigidTransform(rotation_exp(np.array([0.0, 0.3, 0.0])), np.array([-0.2, 0.0, 0.0]))
    second = RigidTransform(rotation_exp(np.array([0.1, 0.0, 0.0])), np.array([-0.1, 0.05, 0.0]))
    camchain(tmp_path / "chain.yaml", [first, second])
    cameras = load_rig(tmp_path / "chain.yaml")
    point = np.array([0.1, -0.2, 1.0])
    np.testing.assert_allclose(cameras[0][1].apply(point), point)
    np.testing.assert_allclose(cameras[2][1].apply(point), second.apply(first.apply(point)))
    assert cameras[2][0].fx == 500.0


def test_single_camera_is_no_rig(tmp_path):
    camchain(tmp_path / "chain.yaml", [])
    with pytest.raises(CameraError, match="is no rig"):
        load_rig(tmp_path / "chain.yaml")


def test_unknown_loads_are_refused():
    """Each camera would count what is known of them once more."""
    loaded = replace(MODEL, energy=SimpleNamespace(loads=SimpleNamespace(count=1), model=MODEL))
    pictures = [np.zeros((part.camera.height, part.camera.width), np.uint8) for part in (LEFT, ASIDE)]
    with pytest.raises(TrackingError, match="one camera"):
        RigTracker(loaded, (LEFT, ASIDE), Registration(loaded, TRUTH), references=pictures)


REFERENCE, ANOTHER, LATER = sheet_state(0.1), sheet_state(0.3), sheet_state(0.6)
TURN = rotation_exp(np.array([0.02, 0.4, -0.05]))
RIG = (
    RigCamera(CAMERA, RigidTransform.identity()),
    RigCamera(
        Camera(640, 480, 500.0, 505.0, 330.0, 236.0),
        RigidTransform(TURN, np.array([0.0, 0.0, 0.6]) - TURN @ np.array([0.0, 0.0, 0.6])),
    ),
)
#: Errors of the reference state's three parameters, rotation vector and translation, one after the other.
STEPS = np.diag([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


def pixels_of(model, part, reference):
    """Places of corners in a camera's picture of the sheet in this state, on it with a margin."""
    nodes = np.random.default_rng(0).choice(len(model.nodes), 200, replace=False)
    inside = np.abs(model.nodes[nodes]) < [0.18, 0.12, 1.0]
    seen = part.seen(reference).camera_from_object.apply(model.positions(reference.parameters))[nodes]
    return part.camera.project(seen[inside.all(axis=1)])


def bound_in(model, part, reference, state):
    """The points that those corners are if the object is in another state, in the rig's frame."""
    view = view_of(model, part.camera, part.seen(state))
    surface, met = bind_pixels(model, part.camera, view, pixels_of(model, part, reference))
    assert met.all()
    return BoundPoints.from_surface(model, surface)


def estimated(model, pictures, depth_weight=None):
    """What exact measurements of a later frame lead to, and by what.

    Each of ``pictures`` has the reference state, what it was taken for, and the factors (9, c) of that error. With
    ``depth_weight``, pixels per metre, each camera measures depth too.
    """
    views, trackers = [], []
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    for part, single in zip(RIG, estimator._single, strict=True):
        every_true = [bound_in(model, part, true, true) for true, _, _ in pictures]
        every = [bound_in(model, part, true, taken) for true, taken, _ in pictures]
        true_points, points = (reduce(BoundPoints.joined, parts) for parts in (every_true, every))
        pixels = part.camera.project(true_points.in_camera(part.seen(LATER)))
        far = true_points.in_camera(part.seen(LATER))[:, 2]
        depths = None if depth_weight is None else PointDepths(far, np.full(len(far), depth_weight), 1.0, 1e6)
        views.append(measured(points, pixels, depths=depths))
        ends, parts = np.cumsum([len(own) for own in every]), []
        for own, end, (_, taken, error_factors) in zip(every, ends, pictures, strict=True):
            seen = None if error_factors is None else part.chain(len(model.parameters)) @ error_factors
            parts.append(BoundPart(slice(end - len(own), end), part.seen(taken), seen))
        reference = SimpleNamespace(points=points, parts=parts, outline_alone=False)
        trackers.append(SimpleNamespace(estimator=single, reference=reference, options=TrackerOptions()))
    seen = RigObservations(tuple(views))
    return estimator.fit(seen, LATER), seen, trackers


def with_errors(trackers, plain, seen, stds):
    """The covariance (9, 9) of an estimate with the errors that are known, the depths' scales with these deviations."""
    errors = RigErrors(trackers, RIG, [CommonDepthScale(std) for std in stds])
    return errors.added(plain, errors.views(plain, seen), None, [0.0] * len(RIG)).covariance


def check_prediction(model, pictures, depth_weight=None):
    found, seen, trackers = estimated(model, pictures, depth_weight)
    plain = replace(found, covariance=np.zeros((9, 9)))
    stated = with_errors(trackers, plain, seen, [0.0] * len(RIG))
    assert_moved_as_stated(LATER, found.state, stated, trackers[0].estimator.scale)


def away_from(before, after):
    """By what (9,) a state is off from another: parameters, rotation vector and translation."""
    pose, true = after.camera_from_object, before.camera_from_object
    turn = pose.rotation @ true.rotation.T
    return np.concatenate(
        [
            after.parameters - before.parameters,
            0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
            pose.translation - true.translation,
        ]
    )


def assert_moved_as_stated(before, after, stated, scale):
    """One deviation of a cause, whose covariance (9, 9) is stated, has moved a state."""
    away, deviations = away_from(before, after) / scale, np.sqrt(np.diag(stated)) / scale
    assert np.linalg.norm(away) > 1e-4
    np.testing.assert_allclose(deviations, np.abs(away), atol=0.1 * np.linalg.norm(away))


def assert_off_as_stated(off, stated, scale, share):
    """Draws (n, 9) of how far an estimate is off have the covariance (9, 9) that is stated, but for a share of it."""
    drawn, stated = np.cov((off / scale).T), stated / np.outer(scale, scale)
    np.testing.assert_allclose(stated, drawn, atol=share * np.linalg.norm(drawn))
    np.testing.assert_allclose(np.sqrt(np.diag(stated)), np.sqrt(np.diag(drawn)), rtol=0.2)


@pytest.mark.parametrize("step", STEPS)
def test_an_error_of_the_reference_moves_later_estimates_as_predicted(model, step):
    check_prediction(model, [(REFERENCE, moved(REFERENCE, step), step[:, None])])


@pytest.mark.parametrize("step", STEPS[[1, 3, 8]])
def test_depths_hold_a_rig_s_estimate_against_an_error_of_the_reference_as_predicted(model, step):
    check_prediction(model, [(REFERENCE, moved(REFERENCE, step), step[:, None])], depth_weight=2000.0)


@pytest.mark.parametrize("step", STEPS)
def test_of_two_pictures_each_is_off_in_its_own_way_by_the_same_cause(model, step):
    other = np.roll(STEPS, 4, axis=0)[np.argmax(step)]
    pictures = [(REFERENCE, step), (ANOTHER, other)]
    check_prediction(model, [(true, moved(true, own), own[:, None]) for true, own in pictures])


def test_what_each_camera_s_outline_leaves_of_the_reference_s_error_moves_the_estimate_as_stated(model):
    """Against draws of the error and of what each outline tells of it; how it moves the estimate is found by fits.

    The outline of one camera tells the factors ten times as exactly as the registration, that of the other hardly.
    """
    rng, factors = np.random.default_rng(6), STEPS[[0, 3, 8]].T
    _, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, factors)])
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    before, moves = estimator.fit(seen, LATER), np.zeros((2, 9, 3))
    for k, step in enumerate(factors.T):
        _, wrong, _ = estimated(model, [(REFERENCE, moved(REFERENCE, step), None)])
        for camera in range(2):
            views = list(seen.views)
            views[camera] = wrong.views[camera]
            moves[camera, :, k] = away_from(before.state, estimator.fit(RigObservations(tuple(views)), LATER).state)
    z, off, corrections = rng.standard_normal((20000, 3)), np.zeros((20000, 9)), []
    for camera, exactness in enumerate((10.0, 0.5)):
        # A camera that finds its depths' scale beside the factors has one more, which is in no other camera.
        own = np.column_stack([z, rng.standard_normal((len(z), 1))]) if camera else z
        count, nothing = own.shape[1], np.zeros(0)
        root = exactness * (np.eye(count) + 0.3 * rng.standard_normal((count, count)))
        information = root @ root.T
        told = own + np.linalg.solve(root.T, rng.standard_normal(own.shape).T).T
        covariance = np.linalg.inv(np.eye(count) + information)
        off += (own - told @ information @ covariance)[:, :3] @ moves[camera].T
        corrections.append(ReferenceCorrection(*[nothing] * 3, sqrtm(covariance).real, *[nothing] * 3))
    errors = RigErrors(trackers, RIG, [CommonDepthScale(), CommonDepthScale(0.01)])
    plain = replace(before, covariance=np.zeros((9, 9)))
    stated = errors.added(plain, errors.views(plain, seen, corrections), None, [0.0, 0.0]).covariance
    assert_off_as_stated(off, stated, estimator.scale, 0.1)


def test_what_depths_leave_of_their_scale_goes_with_what_they_leave_of_the_reference_s_error(model):
    """Against draws: the depths of each camera tell the difference of the distance's error and of their own scale's.

    So both are off together: as the depths agree with the points, neither holds the estimate against the other's error.
    """
    step, std, told_std = 0.05 * STEPS[8], 5e-5, 0.1  # so small that all is linear
    _, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, step[:, None])], depth_weight=2000.0)
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    _, wrong, _ = estimated(model, [(REFERENCE, moved(REFERENCE, step), None)], depth_weight=2000.0)
    before, moves = estimator.fit(seen, LATER), []
    for camera, (right, other) in enumerate(zip(seen.views, wrong.views, strict=True)):
        assert right.depths is not None
        for one in (replace(other, depths=right.depths), replace(right, depths=right.depths.scaled(1.0 + std))):
            views = [*seen.views[:camera], one, *seen.views[camera + 1 :]]
            moves.append(away_from(before.state, estimator.fit(RigObservations(tuple(views)), LATER).state))
    rng, direction = np.random.default_rng(7), np.array([1.0, -1.0]) / np.sqrt(2.0)
    z, off, corrections, nothing = rng.standard_normal(20000), np.zeros((20000, 9)), [], np.zeros(0)
    information = np.outer(direction, direction) / told_std**2
    covariance = np.linalg.inv(np.eye(2) + information)
    for camera in range(2):
        own = np.column_stack([z, rng.standard_normal(len(z))])
        told = own @ direction + told_std * rng.standard_normal(len(z))
        left = own - np.outer(told, direction / told_std**2) @ covariance
        off += left @ np.array(moves[2 * camera : 2 * camera + 2])
        corrections.append(ReferenceCorrection(*[nothing] * 3, sqrtm(covariance).real, *[nothing] * 3))
    errors = RigErrors(trackers, RIG, [CommonDepthScale(std)] * 2)
    plain = replace(before, covariance=np.zeros((9, 9)))
    stated = errors.added(plain, errors.views(plain, seen, corrections), None, [0.0, 0.0]).covariance
    assert_off_as_stated(off, stated, estimator.scale, 0.2)


def test_nothing_is_added_where_nothing_is_known(model):
    found, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, None)])
    errors = RigErrors(trackers, RIG, [CommonDepthScale()] * 2)
    views = errors.views(found, seen)
    left = [view.unexplained.px for view in views]
    assert max(left) < 1e-6
    stated = errors.added(found, views, None, left)
    np.testing.assert_allclose(stated.covariance, found.covariance, atol=1e-12)


@pytest.mark.parametrize("camera", [0, 1])
def test_the_scale_of_a_depth_camera_moves_the_estimate_of_a_rig_as_predicted(model, camera):
    """All depths of one camera are 0.2 % too large; parallax, and the other's depths, hold against them."""
    _, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, None)], depth_weight=2000.0)
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    views = list(seen.views)
    views[camera] = replace(views[camera], depths=views[camera].depths.scaled(1.002))
    before, after = estimator.fit(seen, LATER), estimator.fit(RigObservations(tuple(views)), LATER)
    plain, stds = replace(before, covariance=np.zeros((9, 9))), [0.0, 0.0]
    stds[camera] = 0.002
    stated = with_errors(trackers, plain, seen, stds)
    assert_moved_as_stated(before.state, after.state, stated, estimator.scale)


def test_each_depth_camera_of_a_rig_has_a_scale_of_its_own(model):
    """Against the scatter of estimates whose cameras' depths are too large or too small by 0.2 %, each by itself."""
    _, seen, trackers = estimated(model, [(REFERENCE, REFERENCE, None)], depth_weight=2000.0)
    estimator = RigEstimator(model, RIG, EstimationOptions(huber_px=50.0, max_iterations=50, tolerance=1e-9))
    before = estimator.fit(seen, LATER)
    away = []
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):  # a factor that is two-valued has the same variance
        factors = 1.0 + 0.002 * np.array(signs)
        views = [replace(view, depths=view.depths.scaled(f)) for view, f in zip(seen.views, factors, strict=True)]
        after = estimator.fit(RigObservations(tuple(views)), LATER).state
        moves = after.camera_from_object.translation - LATER.camera_from_object.translation
        away.append([*(after.parameters - LATER.parameters), *moves])
    plain = replace(before, covariance=np.zeros((9, 9)))
    stated = with_errors(trackers, plain, seen, [0.002, 0.002])
    rows = np.array([0, 1, 2, 6, 7, 8])
    scatter = np.sqrt(np.mean(np.square(away), axis=0)) / estimator.scale[rows]
    deviations = np.sqrt(np.diag(stated))[rows] / estimator.scale[rows]
    np.testing.assert_allclose(deviations, scatter, atol=0.05 * np.linalg.norm(scatter))
