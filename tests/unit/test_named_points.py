"""Named points of a run: where they are, how far they move and how well that is known, and what is refused."""

import csv
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.cli.track import print_summary
from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.discrepancy import Discrepancy, DiscrepancyBasis, DiscrepancyDeviation
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.model_errors import ModelDeviation
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.named_points import NamedPoints
from morph_dslam.tracking.outcomes import FoundBy, Rejection, RejectionReason, Status
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_folder import summarise, write_csv, write_hdf5
from morph_dslam.tracking.run_plots import plot_points
from morph_dslam.tracking.run_results import RunResults
from tests.support.bent_sheet import bent_sheet_model
from tests.support.stretched_block import SIZE, stretched_block_model

MODEL = bent_sheet_model(23, 17)  # with a node in the middle
CORNER = ("corner", (0.210, 0.1485, 0.0))
#: Of arch (m), skew and twist (rad): correlated, and a pose that has no part in it.
ROOT = np.array([[1e-3, 0.0, 0.0], [0.02, 0.05, 0.0], [0.01, 0.0, 0.02]])
STATE = np.array([0.04, 0.3, 0.1])


#: Cells along the strip.
STRIP_CELLS = 40


def rolled_strip_model(length):
    """A strip along x that one parameter, an angle, rolls to an arc in the plane of x and z; interpolated exactly."""
    across = np.array([-0.01, 0.01])
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0.0, length, STRIP_CELLS + 1), across, indexing="ij"))
    nodes = np.column_stack([x, y, np.zeros_like(x)])
    first = 2 * np.arange(STRIP_CELLS)[:, None]
    triangles = np.concatenate([np.add(first, [0, 2, 1]), np.add(first, [1, 2, 3])])
    angles = np.cos(np.pi * (np.arange(12) + 0.5) / 12) + 1.0  # Chebyshev's points of the range from 0 to 2
    arcs = []
    for angle in angles:
        turned = angle * x / length
        arcs.append(
            np.column_stack([np.sin(turned) * length / angle, y, (1 - np.cos(turned)) * length / angle]) - nodes
        )
    coefficients = np.polynomial.chebyshev.chebfit(angles - 1.0, np.reshape(arcs, (12, -1)), 11)
    functions = ParameterFunctions(np.zeros(1), np.full(1, 2.0), np.arange(12)[:, None], np.eye(12))
    field = SeparatedField(coefficients.reshape(12, -1, 3), functions)
    return ReducedModel("strip", nodes, triangles, (Parameter("angle", "angle", "rad", 0.0, 2.0, 1.0),), field)


def in_frame(model, parameters, covariance):
    pose = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    d = len(parameters)
    whole = np.diag(np.r_[np.zeros(d), np.full(6, 9.0)])
    whole[:d, :d] = covariance
    estimate = Estimate(
        State(np.array(parameters), pose), 1.0, np.zeros((9, 2)), 0.3, whole, np.zeros(d, bool), 4, True
    )
    return FrameResult(model, Status.TRACKED, estimate, FoundBy.FLOW, residual_rms_px=0.4, unexplained_px=0.0)


def lost_frame(model):
    return FrameResult(model, Status.LOST, rejection=Rejection(RejectionReason.FEW_POINTS, 4, 300, 30))


def run_of(model, places, *results):
    run = RunResults(model, 0, points=NamedPoints.of(model, places))
    for number, result in enumerate(results):
        run.add(number, 0.1 * number, result)
    return run


def test_displacement_of_a_point_inside_is_the_closed_form():
    """A block that is stretched along x by e and sheared along x by s: u = e x + s z / height."""
    model, (x, y, z) = stretched_block_model(), (0.05, 0.02, 0.03)
    stretch_std, slide_std = 0.01, 2e-4
    result = in_frame(model, [0.15, -0.004], np.diag([stretch_std**2, slide_std**2]))
    (found,) = run_of(model, [("inside", (x, y, z))], result).point_displacements()["inside"]
    np.testing.assert_allclose(found.value, [0.15 * x - 0.004 * z / SIZE[2], 0.0, 0.0], atol=1e-12)
    deviation = np.hypot(stretch_std * x, slide_std * z / SIZE[2])
    np.testing.assert_allclose(found.std, [deviation, 0.0, 0.0], atol=1e-12)
    assert found.size_std == pytest.approx(deviation)


def test_deviations_are_finite_differences_times_the_covariance():
    node = int(np.linalg.norm(MODEL.nodes - CORNER[1], axis=1).argmin())
    result = in_frame(MODEL, STATE, ROOT @ ROOT.T)
    (found,) = run_of(MODEL, [CORNER], result).point_displacements()["corner"]
    step = 1e-6
    slopes = np.array(
        [
            (MODEL.positions(STATE + change) - MODEL.positions(STATE - change))[node] / (2.0 * step)
            for change in step * np.eye(3)
        ]
    )
    covariance = slopes.T @ ROOT @ ROOT.T @ slopes
    value = MODEL.positions(STATE)[node] - MODEL.nodes[node]
    np.testing.assert_allclose(found.value, value, atol=1e-12)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(covariance)), rtol=1e-6)
    along = value / np.linalg.norm(value)
    assert found.size_std == pytest.approx(float(np.sqrt(along @ covariance @ along)), rel=1e-6)


def raised_strip_model():
    """A strip whose nodes all rise by 0.1 m times the square of one parameter between -1 and 1: (T0 + T2) / 2."""
    flat = rolled_strip_model(0.4)
    field = np.zeros((2, len(flat.nodes), 3))
    field[:, :, 2] = 0.05
    functions = ParameterFunctions(-np.ones(1), np.ones(1), np.array([[0], [2]]), np.eye(2))
    parameters = (Parameter("side", "ratio", "1", -1.0, 1.0, 0.0),)
    return ReducedModel("raised", flat.nodes, flat.triangles, parameters, SeparatedField(field, functions))


@pytest.mark.parametrize("place", [0.0, 0.3, -0.45])
def test_an_unobservable_parameter_spreads_a_point_as_far_as_its_motion_is_curved(place):
    """Draws one deviation to either side of a square have known moments; none where the derivative is zero."""
    sigma = 0.52
    model = raised_strip_model()
    (found,) = run_of(model, [("end", (0.4, 0.0, 0.0))], in_frame(model, [place], sigma**2)).point_displacements()[
        "end"
    ]
    draws = 0.1 * (place + sigma * np.array([-1.0, 1.0])) ** 2 - 0.1 * place**2
    assert found.value[2] == pytest.approx(0.1 * place**2, abs=1e-12)
    assert found.std == pytest.approx([0.0, 0.0, np.sqrt(np.mean(draws**2))], abs=1e-9)


def test_steps_to_unobservable_values_end_with_the_range():
    """From the upper end, a deviation of 3 down is beyond the lower one, where the height is the same again."""
    model = raised_strip_model()
    (found,) = run_of(model, [("end", (0.4, 0.0, 0.0))], in_frame(model, [1.0], 9.0)).point_displacements()["end"]
    # Over the whole range the first derivative says -0.4 m, and the height does not change.
    assert found.std[2] == pytest.approx(np.hypot(0.2 * 3.0, 0.4), rel=1e-9)


def test_observable_parameters_keep_the_deviations_of_first_order():
    model = raised_strip_model()
    (found,) = run_of(model, [("end", (0.4, 0.0, 0.0))], in_frame(model, [0.3], 0.4**2)).point_displacements()["end"]
    assert found.std[2] == pytest.approx(0.1 * 2.0 * 0.3 * 0.4, rel=1e-9)


def test_a_discrepancy_widens_deviations_by_the_process():
    """A place far from all that was seen: displacements have the process's deviation, and turns that of its slope.

    The turn of a bent plate's corner about z is half the curl; a component of a Matern process (5/2) has slopes of
    variance 5 / 3 amplitude^2 / length^2, independent of those of other components.
    """
    amplitude, length = 2e-3, 0.1
    far = DiscrepancyBasis(np.array([[50.0, 0.0, 0.0]]), length)
    deviation = DiscrepancyDeviation(np.zeros((3, 3)), amplitude, far)
    result = in_frame(MODEL, [0.0, 0.0, 0.0], np.zeros((3, 3)))
    run = run_of(MODEL, [CORNER], replace(result, discrepancy=Discrepancy(far, np.zeros((1, 3)), deviation)))
    assert run.results[0].discrepancy.deviation is None, "runs may be long"
    np.testing.assert_allclose(run.point_displacements()["corner"][0].std, amplitude, rtol=1e-5)
    slope = np.sqrt(5.0 / 3.0) * amplitude / length
    assert run.point_turns()["corner"][0].std == pytest.approx([slope, slope, slope / np.sqrt(2.0)], rel=0.15)
    assert summarise(run)["points"][0]["not_counted"] == []
    np.testing.assert_allclose(
        replace(result, discrepancy=Discrepancy(far, np.zeros((1, 3)), deviation)).position_std(),
        np.sqrt(result.position_std() ** 2 + 3.0 * amplitude**2),
    )


def test_the_largest_displacement_contains_the_discrepancy():
    """A bump on the flat sheet is highest at its centre, where it is what it is known to be there.

    The deviation is that of the bump's components, (0.3, 0.2, 0.6) mm, in its direction.
    """
    middle = np.argmin(np.linalg.norm(MODEL.nodes, axis=1))
    bump, known = np.array([3e-3, 0.0, 4e-3]), np.diag([0.3e-3, 0.2e-3, 0.6e-3]) ** 2
    basis = DiscrepancyBasis(MODEL.nodes[[middle]], 0.05)
    found = Discrepancy(basis, bump[None], DiscrepancyDeviation(known, 1e-3, basis))
    result = replace(in_frame(MODEL, [0.0, 0.0, 0.0], np.zeros((3, 3))), discrepancy=found)
    run = run_of(MODEL, [], result, lost_frame(MODEL), replace(result, discrepancy=None))
    largest = run.largest_displacements()
    assert largest[0] == pytest.approx([5e-3, np.hypot(0.6 * 0.3e-3, 0.8 * 0.6e-3)], rel=1e-3)
    assert np.isnan(largest[1]).all()
    assert largest[2] == pytest.approx([0.0, 0.0], abs=1e-9)
    run.add(3, 0.3, result)
    assert run.last_largest()[0] == pytest.approx(5e-3)


def test_unknown_parameters_leave_a_displacement_open():
    result = in_frame(MODEL, STATE, np.full((3, 3), np.inf))
    (found,) = run_of(MODEL, [CORNER], result).point_displacements()["corner"]
    assert np.isinf([*found.std, found.size_std]).all()


def test_a_strip_that_is_rolled_up_turns_by_its_angle():
    """A strip of length L rolled to an arc of angle a about y: at its end the surroundings have turned by -a."""
    length, angle_std = 0.2, 0.02
    model, angle = rolled_strip_model(length), 1.2
    places = [("clamp", (0.0, 0.0, 0.0)), ("end", (length, 0.0, 0.0))]
    run = run_of(model, places, in_frame(model, [angle], np.array([[angle_std**2]])))
    clamp, end = (run.point_turns()[name][0] for name in ("clamp", "end"))
    # Over the cells beside the end the mean turn is half a cell's less.
    assert end.value == pytest.approx([0.0, -angle, 0.0], abs=0.51 * angle / STRIP_CELLS)
    assert end.std[1] == pytest.approx(angle_std, rel=0.52 / STRIP_CELLS)
    assert (end.std[0], end.std[2]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert (end.size, end.size_std) == pytest.approx((abs(end.value[1]), end.std[1]))
    assert clamp.size == pytest.approx(0.0, abs=0.51 * angle / STRIP_CELLS)


def test_rotations_and_their_deviations_are_those_of_another_library():
    """scipy's fit of the rotation to the corner's neighbours, and its finite differences."""
    result = in_frame(MODEL, STATE, ROOT @ ROOT.T)
    (found,) = run_of(MODEL, [CORNER], result).point_turns()["corner"]
    corner = int(np.linalg.norm(MODEL.nodes - CORNER[1], axis=1).argmin())
    nodes = np.unique(MODEL.triangles[(MODEL.triangles == corner).any(axis=1)])

    def turn(parameters):
        moved, rest = MODEL.positions(parameters)[nodes], MODEL.nodes[nodes]
        return Rotation.align_vectors(moved - moved.mean(axis=0), rest - rest.mean(axis=0))[0]

    np.testing.assert_allclose(found.value, turn(STATE).as_rotvec(), atol=1e-9)
    step, here = 1e-5, turn(STATE)
    slopes = [
        ((turn(STATE + change) * here.inv()).as_rotvec() - (turn(STATE - change) * here.inv()).as_rotvec()) / (2 * step)
        for change in step * np.eye(3)
    ]
    covariance = np.transpose(slopes) @ ROOT @ ROOT.T @ slopes
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(covariance)), rtol=1e-5)


def test_the_models_own_error_is_in_a_rotations_deviation():
    """A body that is turned by w about each axis is displaced by sqrt(2) w times its radius of gyration."""
    exact = in_frame(MODEL, STATE, np.zeros((3, 3)))
    wrong = replace(exact.estimate, by_model=ModelDeviation(np.zeros((3, 3)), np.zeros((3, 3)), 0.0, 1e-3))
    (found,) = run_of(MODEL, [CORNER], replace(exact, estimate=wrong)).point_turns()["corner"]
    away = MODEL.nodes - MODEL.nodes.mean(axis=0)
    about = [Rotation.from_rotvec(1e-6 * axis).apply(away) - away for axis in np.eye(3)]
    displaced = np.sqrt(np.mean([np.sum(np.square(about), axis=(0, 2))]))
    np.testing.assert_allclose(found.std, 1e-3 * 1e-6 / displaced, rtol=1e-3)


@pytest.mark.usefixtures("drawn_figures")
def test_table_file_summary_and_plot_have_each_point(tmp_path, capsys):
    small = in_frame(MODEL, 0.5 * STATE, ROOT @ ROOT.T)
    places = [CORNER, ("middle", (0.0, 0.0, 0.0))]
    run = run_of(MODEL, places, small, in_frame(MODEL, STATE, ROOT @ ROOT.T), lost_frame(MODEL))
    write_csv(tmp_path / "frames.csv", run)
    rows = list(csv.DictReader((tmp_path / "frames.csv").read_text().splitlines()))
    kinds = [f"{axis}{std}_mm" for std in ("", "_std") for axis in "xyz"]
    names = [f"displacement_{name}_{kind}" for name in ("corner", "middle") for kind in kinds]
    assert set(names) < set(rows[0])
    assert [title for title in rows[0] if title.startswith("rotation_corner_")] == [
        f"rotation_corner_{axis}{std}_deg" for std in ("", "_std") for axis in "xyz"
    ]
    assert [rows[2][name] for name in names] == [""] * 12
    # The middle of the sheet goes up by the arch alone.
    assert float(rows[1]["displacement_middle_z_mm"]) == pytest.approx(40.0, abs=1e-3)
    assert float(rows[1]["displacement_middle_z_std_mm"]) == pytest.approx(1.0, abs=1e-2)
    write_hdf5(tmp_path / "result.h5", run)
    with h5py.File(tmp_path / "result.h5") as file:
        np.testing.assert_allclose(file["points/corner/rest"], CORNER[1], atol=1e-12)
        values, deviations = file["points/middle/displacement"][()], file["points/middle/displacement_std"][()]
        turns = file["points/corner/rotation"][()]
    np.testing.assert_allclose(values[:2, 2], [0.02, 0.04], atol=1e-12)
    np.testing.assert_allclose(deviations[:2, 2], 1e-3, rtol=1e-9)
    assert np.isnan([values[2], deviations[2], turns[2]]).all()
    size = float(np.degrees(np.linalg.norm(turns[1])))
    assert summarise(run)["points"][0]["rotation_deg"] == pytest.approx(size)
    summary = summarise(run)
    middle = summary["points"][1]
    assert (middle["name"], middle["at_mm"], middle["frame"]) == ("middle", pytest.approx([0.0] * 3, abs=1e-9), 1)
    print_summary(tmp_path, summary)
    said = capsys.readouterr().out
    law = ", not counting errors of the model's law, supports and loads\n"
    assert f"largest displacement of 'middle': 40 ± 1 mm in frame 1{law}" in said
    assert "largest rotation of 'corner': " in said
    plot_points(tmp_path / "points.png", run)
    assert (tmp_path / "points.png").stat().st_size > 1000


def test_a_run_without_named_points_has_nothing_of_them(tmp_path):
    run = run_of(MODEL, [], in_frame(MODEL, STATE, ROOT @ ROOT.T))
    write_csv(tmp_path / "frames.csv", run)
    assert "displacement_" not in (tmp_path / "frames.csv").read_text().replace("largest_displacement_", "")
    assert summarise(run)["points"] == []


def test_a_place_just_off_the_object_is_drawn_to_it():
    model = stretched_block_model()
    found = NamedPoints.of(model, [("top", (0.02, 0.01, SIZE[2] + 1e-4)), ("inside", (0.02, 0.01, 0.03))])
    assert found is not None
    np.testing.assert_allclose(found.rest, [[0.02, 0.01, SIZE[2]], [0.02, 0.01, 0.03]], atol=1e-9)


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (
            [("tip", (0.02, 0.01, SIZE[2] + 0.012))],
            rf"'tip' at \(20, 10, {1e3 * SIZE[2] + 12:g}\) mm is 12.0 mm off .* the nearest place is \(20, 10, "
            rf"{1e3 * SIZE[2]:g}\) mm",
        ),
        ([("tip", (np.nan, 0.0, 0.0))], "'tip' has no finite coordinates"),
        ([("a/b", (0.0, 0.0, 0.0))], "'a/b' is no name of a point"),
        ([("tip", (0.0, 0.0, 0.0)), ("tip", (0.01, 0.0, 0.0))], "two points are called 'tip'"),
    ],
)
def test_what_is_no_point_of_the_object_is_refused(places, message):
    with pytest.raises(TrackingError, match=message):
        NamedPoints.of(stretched_block_model(), places)


def test_points_of_a_rigid_object_are_refused():
    with pytest.raises(TrackingError, match="is rigid"):
        NamedPoints.of(replace(MODEL, parameters=()), [CORNER])


@pytest.mark.parametrize("text", ["tip", "tip=1,2", "=1,2,3", "tip=1,2,x", "tip=1,2,inf", "tip=1,2,3,4"])
def test_what_is_no_name_with_coordinates_is_refused(text, refused):
    assert "not a name and three coordinates in millimetres" in refused("track", "frames", "--point", text)
