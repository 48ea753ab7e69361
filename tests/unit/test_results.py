"""What a run says about itself: flags, the side of the object that is seen, and hidden points."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.cli.track import print_summary
from morph_dslam.errors import MorphError, ParameterError, TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel, SeparatedField, SurfacePoints
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.stated_errors import unknown_mesh_error
from morph_dslam.tracking.binding import facing, view_of
from morph_dslam.tracking.drawing import AugmentedView
from morph_dslam.tracking.estimator import BoundPoints, Estimate, State
from morph_dslam.tracking.measurement import ReferenceAppearance, visible_surface
from morph_dslam.tracking.outcomes import (
    BlurredByMotion,
    CameraIgnored,
    CameraLost,
    CamerasDisagree,
    DepthNotUsed,
    FewPointsAgree,
    FoundBy,
    KnownRefuted,
    ModelDoesNotExplain,
    ObjectMoved,
    OtherReferenceView,
    ReferenceBlurred,
    Rejection,
    RejectionReason,
    SamePlace,
    Status,
    TiltAmbiguous,
    TimeOutside,
)
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.run_folder import summarise
from morph_dslam.tracking.run_notices import RunNotice, RunWarning, notices_of
from morph_dslam.tracking.run_results import RunResults
from tests.support.bent_sheet import PARAMETERS, bent_sheet_model
from tests.support.rendered_sequence import CAMERA

FRONT = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
MODEL = bent_sheet_model(22, 16)
BACK = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.0, 0.6]))


def frame_result(parameters, deviations, at_bound, milliseconds=2.0):
    state = State(np.array(parameters), FRONT)
    covariance = np.diag([*np.square(deviations), *[1e-8] * 6])
    estimate = Estimate(state, 1.0, np.zeros((9, 2)), 0.3, covariance, np.array(at_bound), 4, True)
    times = dict.fromkeys(STAGES, milliseconds)
    return FrameResult(
        MODEL,
        Status.TRACKED,
        estimate,
        FoundBy.FLOW,
        n_points=300,
        n_inliers=280,
        residual_rms_px=0.4,
        timings_ms=times,
        total_ms=milliseconds * len(STAGES) + 0.5,
    )


def lost_result():
    rejection = Rejection(RejectionReason.FEW_POINTS, 4, 300, 30)
    times = dict.fromkeys(STAGES, 1.0)
    return FrameResult(
        MODEL, Status.LOST, rejection=rejection, n_points=300, n_inliers=4, timings_ms=times, total_ms=7.0
    )


def test_what_a_lost_frame_or_a_model_has_not_is_named():
    lost, tracked = lost_result(), frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False] * 3)
    for ask in (lost.displacement, lost.positions, lost.von_mises, lost.von_mises_std, lost.strain, lost.reactions):
        with pytest.raises(MorphError):
            ask()
    with pytest.raises(TrackingError, match="it is lost, 4 of 300 points agree"):
        lost.displacement()
    for ask in (tracked.von_mises, tracked.von_mises_std):
        with pytest.raises(ParameterError, match="no stress 'solid'; it has top, bottom"):
            ask("solid")
        with pytest.raises(ParameterError, match="no stress; it has none"):
            getattr(replace(tracked, model=replace(MODEL, stresses={})), ask.__name__)()
    with pytest.raises(ParameterError, match="no strain"):
        tracked.strain()


def test_deviation_of_stress_is_that_of_the_face_with_more_stress():
    top = MODEL.stresses["top"]
    # Twice the stress on one half of the bottom, half of it on the other.
    half = np.where(MODEL.nodes[:, 0] < 0.0, 2.0, 0.5)
    model = replace(MODEL, stresses={"top": top, "bottom": top.with_modes(top.modes * half[:, None])})
    result = replace(frame_result([0.03, 0.1, 0.1], [1e-3, 0.05, 0.01], [False] * 3), model=model)
    larger = np.maximum(half, 1.0)
    np.testing.assert_allclose(result.von_mises(), larger * result.von_mises("top"))
    np.testing.assert_allclose(result.von_mises_std(), larger * result.von_mises_std("top"))


def test_a_common_error_of_the_moduli_counts_in_forces_as_the_tracker_has_it():
    functions = MODEL.displacement.functions
    modes = np.zeros((len(MODEL.displacement.modes), 1, 3))
    modes[0] = [3.0, 4.0, 0.0]
    model = replace(MODEL, reactions={"force_end": SeparatedField(modes, functions)})
    exact = frame_result([0.03, 0.1, 0.1], [0.0] * 3, [False] * 3)
    result = replace(exact, model=model, modulus_std=0.1)
    force = result.reactions()["end"].force
    assert force.size > 0.0
    assert force.size_std == pytest.approx(0.1 * force.size)
    assert result.reactions(0.05)["end"].force.size_std == pytest.approx(0.05 * force.size)
    assert result.reactions(0.0)["end"].force.size_std == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(TrackingError, match="modulus_std is 5: give a share"):
        result.reactions(5)


def test_results_are_shown_in_one_line_that_says_the_status_once():
    lost, tracked = lost_result(), frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False] * 3)
    assert lost.reason == "4 of 300 points agree, at least 30 needed"
    assert repr(lost) == f"FrameResult(lost, '{lost.reason}')"
    assert "arch=10±1 mm" in repr(tracked)
    assert "280 of 300 points agree" in repr(tracked)
    assert len(repr(tracked)) < 200


def test_summary_counts_and_flags():
    run = RunResults(bent_sheet_model(22, 16), reference_frame=3)
    run.add(3, 0.0, frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False]))
    run.add(4, 0.1, frame_result([0.06, 0.1, 0.0], [1e-3, 5.0, 0.01], [True, False, False], 4.0))
    run.add(5, 0.2, lost_result())
    summary = summarise(run)
    assert (summary["n_frames"], summary["n_tracked"], summary["n_lost"]) == (3, 2, 1)
    assert summary["median_ms"] == pytest.approx(2.0 * len(STAGES) + 0.5)
    assert summary["median_n_inliers"] == 280
    at_bound, lost, unobservable = notices_of(run)
    assert lost == RunNotice.of(RunWarning.LOST, count=1, n_frames=3)
    assert "1 of 3 frames was lost" in lost.text
    data = {"parameter": "arch", "side": "upper", "bound": "60 mm", "count": 1}
    assert at_bound == RunNotice.of(RunWarning.AT_BOUND, **data)
    assert (unobservable.warning, unobservable.data["parameters"]) == (RunWarning.UNOBSERVABLE, ["skew"])
    assert summary["flags"] == [at_bound.text, lost.text, unobservable.text]
    assert summary["notices"][0] == {"kind": "at_bound", **data, "text": at_bound.text}
    # Were it an angle about an axis of revolution, it would be the same a turn further on.
    turning = replace(run, revolution_angles=("arch",))
    assert notices_of(turning) == [lost, unobservable]
    assert not turning.at_bound().any()


def test_a_run_by_the_outline_alone_says_why():
    """Asked for, or for want of corners: so many of so many."""
    sound = frame_result([0.0, 0.0, 0.0], [1e-3, 0.01, 0.01], [False] * 3)
    for few, reason in (((21, 30), "shows 21 corners in the reference and 30 are needed"), (None, "--no-texture")):
        run = RunResults(MODEL, reference_frame=0)
        run.add(0, 0.0, sound)
        run.add(1, 0.1, replace(sound, by_outline=True, few_corners=few))
        (notice,) = notices_of(run)
        assert "outline alone in 1 of 2 frames" in notice.text
        assert reason in notice.text


def test_an_outline_that_has_an_object_at_rest_deformed_is_named():
    """By more than four deviations; texture counts from the reference frame, whatever its parameters are there."""
    arched = frame_result([0.5e-3, 0.03, 0.0], [1e-4, 0.01, 0.01], [False] * 3)
    for by_outline, at_rest, said in ((True, True, True), (True, False, False), (False, True, False)):
        run = RunResults(MODEL, reference_frame=3, at_rest=at_rest)
        run.add(3, 0.0, replace(arched, by_outline=by_outline))
        found = [notice for notice in notices_of(run) if notice.warning is RunWarning.DEFORMED_AT_REST]
        assert [notice.data for notice in found] == ([{"frame": 3, "values": "arch = 0.5 ± 0.1 mm"}] if said else [])


PER_FRAME = [
    (ObjectMoved(), RunWarning.MOVED),
    (FewPointsAgree(0.5), RunWarning.FEW_AGREE),
    (TiltAmbiguous(0.3, 40.0), RunWarning.TILT_AMBIGUOUS),
    (BlurredByMotion(9.0), RunWarning.BLURRED_BY_MOTION),
    (ReferenceBlurred(9.0), RunWarning.REFERENCE_BLURRED),
    (SamePlace("twin"), RunWarning.SAME_PLACE),
    (TimeOutside("hold", "21 s", "0 to 20 s"), RunWarning.TIME_OUTSIDE),
    (TimeOutside("hold", "-2 s", "0 to 20 s", is_before=True), RunWarning.TIME_BEFORE),
    (KnownRefuted("arch", "3 mm", "5 mm", 7.0), RunWarning.KNOWN_REFUTED),
    (ModelDoesNotExplain(0.7), RunWarning.MODEL_FAILS),
    (ModelDoesNotExplain(0.7, 5.0), RunWarning.SHIFTED),
    (CamerasDisagree(0.7), RunWarning.CAMERAS_DISAGREE),
    (CameraLost("too few points"), RunWarning.CAMERA_LOST),
    (CameraIgnored(1, Status.LOST), RunWarning.CAMERA_IGNORED),
    (DepthNotUsed(), RunWarning.DEPTH_NOT_USED),
]


@pytest.mark.parametrize(("warning", "expected"), PER_FRAME)
def test_a_run_says_in_how_many_frames_it_warns_and_in_which_first(warning, expected):
    run = RunResults(MODEL, reference_frame=0)
    frames = [(), (OtherReferenceView(1),), (warning,), (), (warning, OtherReferenceView(1))]
    for number, warnings in enumerate(frames):
        sound = frame_result([0.0, 0.0, 0.0], [1e-3, 0.01, 0.01], [False] * 3)
        run.add(10 + number, 0.1 * number, replace(sound, warnings=warnings))
    (notice,) = notices_of(run)
    assert (notice.warning, notice.data["count"], notice.data["first"]) == (expected, 2, 12)
    assert "first in frame 12" in notice.text


def test_only_a_recording_that_is_before_the_models_time_throughout_is_called_wrong():
    run = RunResults(MODEL, reference_frame=0)
    before = TimeOutside("hold", "-2 s", "0 to 20 s", is_before=True)
    sound = frame_result([0.0, 0.0, 0.0], [1e-3, 0.01, 0.01], [False] * 3)
    run.add(0, 0.0, replace(sound, warnings=(before,)))
    assert [notice.warning for notice in notices_of(run)] == [RunWarning.TIME_OUTSIDE]
    run.add(1, 0.1, sound)
    run.add(2, 0.2, replace(sound, warnings=(TimeOutside("hold", "21 s", "0 to 20 s"),)))
    assert [(n.warning, n.data["count"], n.data["first"]) for n in notices_of(run)] == [
        (RunWarning.TIME_BEFORE, 1, 0),
        (RunWarning.TIME_OUTSIDE, 1, 2),
    ]


@pytest.mark.parametrize(("error", "is_told"), [(7e-12, False), (2e-6, True)])
def test_a_force_does_not_say_that_rounding_is_not_counted(tmp_path, capsys, error, is_told):
    modes = np.zeros((len(MODEL.displacement.modes), 1, 3))
    modes[0] = [3.0, 4.0, 0.0]
    force = SeparatedField(modes, MODEL.displacement.functions)
    stated = {"relative_l2": error, "largest_N": 50.0}
    model = replace(MODEL, certificate={"reaction_force_end": stated}, reactions={"force_end": force})
    run = RunResults(model, reference_frame=0)
    run.add(0, 0.0, replace(frame_result([0.03, 0.1, 0.1], [1e-3, 0.05, 0.01], [False] * 3), model=model))
    print_summary(tmp_path, summarise(run))
    said = capsys.readouterr().out
    assert ("at given parameters" in said) == is_told
    assert "N in frame 0, not counting" in said


def test_fields_that_the_model_misses_are_named_and_forces_say_what_their_deviations_lack(tmp_path, capsys):
    """A side that holds a hundredth of the force counts by that."""
    modes = np.zeros((len(MODEL.displacement.modes), 1, 3))
    modes[0] = [3.0, 4.0, 0.0]
    force = SeparatedField(modes, MODEL.displacement.functions)
    certificate = {
        "stress_top": {"relative_l2": 0.3, "von_mises": {"relative_l2": 0.34, "largest_MPa": 80.0}},
        "reaction_force_end": {"relative_l2": 0.04, "largest_N": 50.0},
        "reaction_force_side": {"relative_l2": 3.9, "largest_N": 0.5},
        "discretisation": {"errors": {"reaction_force_end": {"relative_l2": 0.02}}},
    }
    model = replace(MODEL, certificate=certificate, reactions={"force_end": force, "force_side": force})
    run = RunResults(model, reference_frame=0)
    run.add(0, 0.0, replace(frame_result([0.03, 0.1, 0.1], [1e-3, 0.05, 0.01], [False] * 3), model=model))
    summary = summarise(run)
    (flag,) = [notice for notice in summary["notices"] if notice["kind"] == "doubtful_fields"]
    assert flag["relative"] == pytest.approx({"von Mises stress": 0.34})
    assert "misses 34 % of von Mises stress at held-out solutions" in flag["text"]
    print_summary(tmp_path, summary)
    said = capsys.readouterr().out
    law = ", and errors of the model's law, supports and loads\n"
    assert f"N in frame 0, not counting the model's own error at given parameters, 6 %{law}" in said
    assert f"N in frame 0, not counting the model's own reduction error at given parameters, 390 %{law}" in said
    sides = {name: {**entry, "largest_N": 50.0} for name, entry in certificate.items() if name.endswith("_side")}
    swapped = replace(run, model=replace(model, certificate=certificate | sides))
    assert "34 % of von Mises stress and 390 % of forces" in notices_of(swapped)[0].text


@pytest.mark.parametrize(
    ("stated", "is_told"),
    [
        ({"not_estimated": "it takes long", "estimable": True}, True),
        ({"not_estimated": "the solutions are another program's", "estimable": False}, False),
        ({"errors": {}}, False),
    ],
)
def test_a_mesh_whose_error_was_not_estimated_is_named_once(stated, is_told):
    model = replace(MODEL, certificate={"discretisation": stated})
    run = RunResults(model, reference_frame=0)
    for number in range(3):
        run.add(number, 0.1 * number, frame_result([0.0, 0.0, 0.0], [1e-3, 0.01, 0.01], [False] * 3))
    notices = notices_of(run)
    assert [notice.warning for notice in notices] == [RunWarning.MESH_ERROR_UNKNOWN] * is_told
    assert all("was not estimated (it takes long)" in notice.text for notice in notices)
    assert unknown_mesh_error(replace(model, parameters=())) is None


def test_a_bound_where_the_undeformed_object_rests_is_no_warning():
    model = bent_sheet_model(22, 16)
    arch = replace(model.parameters[0], lower=0.0, default=0.0)
    run = RunResults(replace(model, parameters=(arch, *model.parameters[1:])), reference_frame=0)
    run.add(0, 0.0, frame_result([0.0, 0.1, 0.0], [1e-3, 0.05, 0.01], [True, False, False]))
    run.add(1, 0.1, frame_result([0.06, 0.1, 0.0], [1e-3, 0.05, 0.01], [True, False, False]))
    (reached,) = notices_of(run)
    assert (reached.warning, reached.data["side"]) == (RunWarning.AT_BOUND, "upper")


def held(stated, widened, parameters=(0.06, 0.1, 0.0), **facts):
    """A frame whose arch is at a bound; its deviation (m) as stated, and as the residuals widen it."""
    result = frame_result(parameters, [widened, 0.05, 0.01], [True, False, False])
    covariance = np.diag([stated**2, 0.05**2, 0.01**2, *[1e-8] * 6])
    return replace(result, estimate=replace(result.estimate, stated_covariance=covariance), **facts)


def test_a_range_that_is_left_is_named_in_all_frames_and_not_as_unobservable():
    """The arch's range is 120 mm wide: deviations from 30 mm on leave it open."""
    run = RunResults(bent_sheet_model(22, 16), reference_frame=0)
    run.add(0, 0.0, held(1e-3, 5e-3))
    run.add(1, 0.1, held(1e-3, 0.05, unexplained_px=0.8))
    run.add(2, 0.2, held(1e-3, 0.05, reference_factor=9.0))
    first, *others = notices_of(run)
    assert first == RunNotice.of(RunWarning.AT_BOUND, parameter="arch", side="upper", bound="60 mm", count=3)
    assert others == []
    inside = frame_result([0.02, 0.1, 0.0], [1e-3, 0.05, 0.01], [False] * 3)
    run.add(3, 0.3, replace(inside, reference_factor=9.0))  # asked for by a frame that the model covers
    assert [notice.warning for notice in notices_of(run)[1:]] == [RunWarning.REFERENCE_WIDENED]


@pytest.mark.parametrize(
    ("stated", "widened", "facts"),
    [
        (0.05, 0.05, {"unexplained_px": 0.8}),  # nobody knows where it is, with the misfit or without
        (1e-3, 0.05, {"unexplained_px": 0.05}),  # what is hidden in part widened it, not the residuals
    ],
)
def test_what_the_images_do_not_determine_is_not_said_to_have_left_its_range(stated, widened, facts):
    run = RunResults(bent_sheet_model(22, 16), reference_frame=0)
    run.add(0, 0.0, held(stated, widened, **facts))
    (unobservable,) = notices_of(run)
    assert unobservable.data["parameters"] == ["arch"]


def test_stress_shown_is_that_of_the_side_turned_to_the_camera():
    model = bent_sheet_model(22, 16)
    # Make the faces tell apart: nothing on the bottom.
    top = model.stresses["top"]
    model = replace(model, stresses={"top": top, "bottom": replace(top, modes=0.0 * top.modes)})
    parameters = np.array([0.04, 0.0, 0.0])
    for pose, expected in ((FRONT, True), (BACK, False)):
        state = State(parameters, pose)
        view = AugmentedView(model, CAMERA)
        assert view.label == "von Mises stress [MPa]"
        assert (view.values(state).max() > 0.0) == expected


def test_models_without_stress_show_the_displacement():
    model = replace(bent_sheet_model(22, 16), stresses={})
    state = State(np.array([0.04, 0.0, 0.0]), FRONT)
    view = AugmentedView(model, CAMERA)
    assert view.label == "displacement [mm]"
    values = view.values(state)
    assert values.max() == pytest.approx(40.0, rel=0.02)
    low, high = view.range_of([state])
    assert low == 0.0
    assert 30.0 < high <= values.max()
    assert view.range_of([]) == (0.0, 1.0)
    # The box allows arches of 60 mm.
    assert high < view.range_of_box()[1] < 66.0


def two_layers():
    """Two parallel squares of 0.2 m, the second 0.1 m behind the first for a camera at +z."""
    square = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    nodes = np.concatenate([square, square - [0.0, 0.0, 0.1]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    functions = ParameterFunctions(-np.ones(3), np.ones(3), np.zeros((1, 3), np.int64), np.zeros((1, 1)))
    field = SeparatedField(np.zeros((1, 8, 3)), functions)
    return ReducedModel("layers", nodes, triangles, PARAMETERS, field)


def test_points_hidden_by_the_object_or_turned_away_are_not_visible():
    model = two_layers()
    points = BoundPoints.from_surface(
        model, SurfacePoints(np.arange(4), np.array([[0.4, 0.3, 0.3]] * 3 + [[0.3, 0.4, 0.3]]))
    )
    front = State(np.zeros(3), FRONT)
    normalized = np.full((480, 640), 90, np.uint8)
    appearance = ReferenceAppearance(model, CAMERA, [normalized], [view_of(model, CAMERA, front)])

    is_front = facing(view_of(model, CAMERA, front), model.triangles)

    def visible(state, broadness=0.0):
        positions, corners = points.in_camera(state), points.corners(model).in_camera(state)
        depth = appearance.render(view_of(model, CAMERA, state)).depth
        return visible_surface(
            corners, CAMERA.project(corners), is_front, np.full(4, broadness), positions, CAMERA.project(positions),
            depth, 0.001,
        ).tolist()  # fmt: skip

    assert visible(front) == [True, True, False, False]
    assert visible(State(np.zeros(3), BACK)) == [False, False, False, False]
    # Half of the square of 0.2 m, at any distance: its area times the squared focal length.
    area = 0.5 * 0.2**2 * CAMERA.fx * CAMERA.fy
    assert visible(front, 0.99 * area) == [True, True, False, False]
    assert visible(front, 1.01 * area) == [False, False, False, False]


RIM = [(8, 240, True), (7, 240, False), (630, 240, True), (631, 240, False), (320, 7, False), (320, 471, False)]


@pytest.mark.parametrize(("column", "row", "is_whole"), RIM)
def test_points_whose_windows_leave_the_picture_are_not_visible(column, row, is_whole):
    """A patch of 15 pixels and one more on each side, of which a place between pixels needs the next one."""
    pixels = np.array([[column, row]], dtype=np.float64)
    corner_pixels = pixels + np.array([[-100.0, 100.0], [100.0, 100.0], [0.0, -200.0]])
    corners, depth = np.tile([0.0, 0.0, 1.0], (3, 1)), np.ones((480, 640), np.float32)
    found = visible_surface(
        corners, corner_pixels, np.array([False]), np.zeros(1), corners[:1], pixels, depth, 0.01
    )  # fmt: skip
    assert found.tolist() == [is_whole]
