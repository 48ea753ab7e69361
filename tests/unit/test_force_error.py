"""Forces against closed forms: curves that are a known factor times the model's force and a known offset."""

import json
from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import EvaluationError
from morph_dslam.extend.reports import ForceCurve, evaluate_force, force_remarks
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA
from tests.support.run_folders import FRAMES, states, write_run

LARGEST = 0.060


def reaction(force):
    """A force (3,) N times X + (2 X² - 1) / 4 with X = arch / 60 mm, in Chebyshev polynomials T1 + T2 / 4."""
    powers, shares = np.array([[1, 0, 0], [2, 0, 0]]), np.array([[1.0], [0.25]])
    upper = bent_sheet_model(3, 3).upper
    return SeparatedField(np.array([[force]], dtype=float), ParameterFunctions(-upper, upper, powers, shares))


def pull(arch):
    """The closed form of the force on "clamp" against x, newtons."""
    x = np.asarray(arch) / LARGEST
    return 5.0 * (x + 0.25 * (2.0 * x**2 - 1.0))


def model():
    held = {"force_clamp": reaction([-5.0, 0.5, 0.0]), "force_foot": reaction([2.0, 0.0, 1.0])}
    return replace(bent_sheet_model(22, 16), reactions=held)


ARCHES = np.linspace(0.005, 0.050, 10)


def pulled_run(arches=ARCHES):
    parameters = np.column_stack([arches, np.zeros((len(arches), 2))])
    poses, words = np.tile(np.eye(4), (len(arches), 1, 1)), ("tracked",) * len(arches)
    return md.Run(model(), CAMERA, np.arange(len(arches)), words, words, poses, parameters, {"total": np.ones(2)})


def test_factor_and_offset_are_those_of_the_curve():
    figures = evaluate_force(pulled_run(), ForceCurve("frame", np.arange(10.0), 1.3 * pull(ARCHES) + 0.7))
    assert figures["factor"] == pytest.approx(1.3, abs=1e-9)
    assert figures["offset_N"] == pytest.approx(0.7, abs=1e-9)
    assert figures["rms_N"] < 1e-9
    assert (figures["support"], figures["direction"]) == ("clamp", "-x"), "its largest force, as the measured one grows"
    expected = np.sqrt(np.mean((0.3 * pull(ARCHES) + 0.7) ** 2))
    assert figures["rms_without_fit_N"] == pytest.approx(expected)


def test_what_the_fit_leaves_is_the_noise():
    """Least squares by numpy's polynomial fit; the range of the measured force is that of the noisy curve."""
    noise = 0.1 * np.array([1, -1, 1, 1, -1, -1, 1, -1, 1, -1])
    measured = 2.0 * pull(ARCHES) + noise
    figures = evaluate_force(pulled_run(), ForceCurve("frame", np.arange(10.0), measured))
    (slope, offset), covariance = np.polyfit(pull(ARCHES), measured, 1, cov=True)
    assert (figures["factor"], figures["offset_N"]) == pytest.approx((slope, offset))
    assert figures["factor_std"] == pytest.approx(np.sqrt(covariance[0, 0]))
    left = np.sqrt(np.mean((slope * pull(ARCHES) + offset - measured) ** 2))
    assert figures["rms_N"] == pytest.approx(left)
    assert figures["relative_rms"] == pytest.approx(left / (measured.max() - measured.min()))


def test_a_curve_by_a_parameter_is_read_between_its_points():
    """Straight between 0 and 32 mm; frames beyond are not compared."""
    run = pulled_run()
    curve = ForceCurve("arch", np.array([0.0, 0.016, 0.032]), np.array([0.0, 1.6, 3.2]))
    figures = evaluate_force(run, curve)
    assert figures["frames_compared"] == [0, 1, 2, 3, 4, 5]
    assert figures["tracked_frames_off_the_curve"] == [6, 7, 8, 9]
    measured = [figures["per_frame"][str(frame)]["measured_N"] for frame in range(6)]
    np.testing.assert_allclose(measured, 100.0 * ARCHES[:6])


def test_frames_between_two_rows_of_a_curve_tell_nothing_of_it():
    """A curve in millimetres whose column says metres."""
    curve = ForceCurve("arch", np.array([0.0, 10.0, 20.0, 30.0]), np.array([0.0, 1.0, 2.0, 3.0]))
    with pytest.raises(
        EvaluationError, match=r"all 10 frames .* between two neighbouring rows .* arch \[mm\] 0 to 30000"
    ):
        evaluate_force(pulled_run(), curve)


def test_frames_on_a_small_part_of_a_curve_are_noted():
    """45 mm of 4.5 m are 1 % of it."""
    places = np.linspace(0.0, 4.5, 1001)
    figures = evaluate_force(pulled_run(), ForceCurve("arch", places, places))
    assert figures["share_of_curve"] == pytest.approx(0.01)
    assert "the frames compared cover 1 % of the curve's range of arch" in "\n".join(force_remarks(figures))


@pytest.mark.parametrize(
    ("asked", "factor", "direction"),
    [
        ("clamp:x", 1.0, "-x"),
        ("clamp:-x", 1.0, "-x"),
        ("clamp:y", 10.0, "y"),
        ("foot", 2.5, "x"),
        ("foot:+z", 5.0, "z"),
    ],
)
def test_support_and_direction_may_be_named(asked, factor, direction):
    figures = evaluate_force(pulled_run(), ForceCurve("frame", np.arange(10.0), pull(ARCHES)), reaction=asked)
    assert figures["factor"] == pytest.approx(factor)
    assert figures["direction"] == direction


@pytest.mark.parametrize(
    ("places", "asked", "message"),
    [
        (np.arange(10.0), "lid", "no force on 'lid'; it has those on clamp, foot"),
        (
            np.arange(10.0),
            "clamp:z",
            "'clamp' along z is zero in this model; it acts along x: write --reaction clamp:x",
        ),
        (np.arange(10.0), "clamp:+x", "in direction x falls where .* write --reaction clamp:-x"),
        (np.arange(10.0), "clamp:-y", "in direction -y falls where .* write --reaction clamp:\\+y"),
        (np.arange(10.0) + 8, None, "2 of the tracked frames lie on the curve"),
        (np.arange(10.0) % 5, None, "more than once"),
    ],
)
def test_what_cannot_be_compared(places, asked, message):
    with pytest.raises(EvaluationError, match=message):
        evaluate_force(pulled_run(), ForceCurve("frame", places, pull(ARCHES)), reaction=asked)


@pytest.mark.parametrize("of_clamp", [3.6e-15, 1e-7])
def test_rounding_noise_of_a_support_is_no_force(of_clamp):
    """Along y there is nothing but noise, which grows with the measured force: its fit would be perfect."""
    noisy = replace(model(), reactions={"force_clamp": reaction([-5.0, 5.0 * of_clamp, 0.0])})
    run = replace(pulled_run(), model=noisy)
    with pytest.raises(EvaluationError, match="along y is zero in this model; it acts along x"):
        evaluate_force(run, ForceCurve("frame", np.arange(10.0), pull(ARCHES)), reaction="clamp:y")


def test_a_small_force_across_the_main_one_is_a_force():
    small = replace(model(), reactions={"force_clamp": reaction([-5.0, 5e-3, 0.0])})
    run = replace(pulled_run(), model=small)
    figures = evaluate_force(run, ForceCurve("frame", np.arange(10.0), pull(ARCHES)), reaction="clamp:y")
    assert figures["factor"] == pytest.approx(1e3)


def test_a_measured_force_that_does_not_change_gives_no_factor():
    for force in (5.0, 0.0):
        with pytest.raises(EvaluationError, match=f"the measured force is {force:g} N in all frames"):
            evaluate_force(pulled_run(), ForceCurve("frame", np.arange(10.0), np.full(10, force)))


def stating(relative, mesh=None):
    """The run of a model that states the relative error of its reduction, and of its mesh."""
    errors = {} if mesh is None else {"errors": {"reaction_force_clamp": {"relative_l2": mesh}}}
    stated = {"reaction_force_clamp": {"relative_l2": relative, "largest_N": 10.0}, "discretisation": errors}
    return replace(pulled_run(), model=replace(model(), certificate=stated))


@pytest.mark.parametrize(("relative", "mesh"), [(0.05, None), (0.01, 0.04)])
def test_a_force_that_may_change_by_error_alone_gives_no_factor(relative, mesh):
    """Along y it changes by a tenth of what it does along x, 0.39 N; two states may miss by 0.5 N each."""
    run, curve = stating(relative, mesh), ForceCurve("frame", np.arange(10.0), pull(ARCHES))
    with pytest.raises(EvaluationError, match=r"may be off by 1 N by the .*: write --reaction clamp:x"):
        evaluate_force(run, curve, reaction="clamp:y")
    figures = evaluate_force(run, curve, reaction="clamp:x")
    assert figures["own_error_of_model_N"] == pytest.approx(1.0)
    assert figures["change_of_model_N"] == pytest.approx(np.ptp(pull(ARCHES)))
    assert len(force_remarks(figures)) == 1


def test_a_force_that_changes_by_more_than_its_error_gives_a_factor():
    curve = ForceCurve("frame", np.arange(10.0), pull(ARCHES))
    assert evaluate_force(stating(0.015), curve, reaction="clamp:y")["factor"] == pytest.approx(10.0)


def test_where_no_axis_has_more_a_note_says_that_the_factor_means_little():
    curve = ForceCurve("frame", np.arange(10.0), pull(ARCHES))
    figures = evaluate_force(stating(0.5), curve)
    assert (figures["factor"], figures["own_error_of_model_N"]) == pytest.approx((1.0, 10.0))
    assert "may be off by 10 N by the model's own error" in force_remarks(figures)[1]


def test_a_force_that_does_not_change_gives_no_factor():
    run = pulled_run(np.full(10, 0.02))
    with pytest.raises(EvaluationError, match="the same in all frames"):
        evaluate_force(run, ForceCurve("frame", np.arange(10.0), pull(ARCHES)))


def test_a_model_without_reactions_says_so():
    run = replace(pulled_run(), model=bent_sheet_model(22, 16))
    with pytest.raises(EvaluationError, match="holds no reaction of a support"):
        evaluate_force(run, ForceCurve("frame", np.arange(10.0), pull(ARCHES)))


@pytest.fixture
def folder(tmp_path):
    """A run folder whose frame 12 was lost, and its curve in millinewtons beside another column."""
    write_run(tmp_path / "run", ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    md.save_model(tmp_path / "run" / "model.morph", model())
    arches = states(len(FRAMES))[0][:, 0]
    lines = [f"{n},{1e3 * (1.3 * pull(a) - 0.2):.9f},0" for n, a in zip(FRAMES, arches, strict=True)]
    (tmp_path / "curve.csv").write_text("\n".join(["frame,pull_mN,other_N", *lines, "99,,1"]) + "\n")
    return tmp_path


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_writes_figures_a_plot_and_a_section_of_the_report(folder, capsys):
    run = folder / "run"
    assert main(["evaluate", str(run), "--force", f"{folder / 'curve.csv'}:pull_mN", "--reaction", "clamp"]) == 0
    lines = capsys.readouterr().out.splitlines()
    # Modes are kept in single precision.
    assert lines[-1].startswith("factor=1.3000 offset=-0.2000 rms=0.0000 relative_rms=0.0000 frames=5/6 tracked=5/6")
    assert lines[0] == "note: the force on 'clamp' in direction -x of the object frame"
    assert json.loads((run / "force_evaluation.json").read_text())["frames_compared"] == [10, 11, 13, 14, 15]
    assert (run / "force_evaluation.png").read_bytes().startswith(b"\x89PNG")
    page = (run / "report.html").read_text()
    assert "1.3000, standard deviation 0.0000" in page
    assert page.count("data:image/png;base64,") == 1


@pytest.mark.parametrize(
    ("text", "column", "message"),
    [
        ("frame,a_N,b_N\n1,2,3\n", "", "several columns of forces"),
        ("frame,a_N\n1,2\n", ":c_N", "no column 'c_N'"),
        ("frame;a_N\n1;2\n", "", "separated by semicolons"),
        ("", "", "the first column is ''"),
        ("arch,force_N\n1,2\n", "", "arch_mm"),
        ("arch_deg,force_N\n1,2\n", "", "arch_mm"),
        ("frame,force_N\n1,x\n", "", "'1,x' is not a place"),
        ("frame,force_N\n1,2\n2,3\n", "", "has 2 forces"),
    ],
)
def test_a_file_that_cannot_be_meant_is_one_message(folder, refused, text, column, message):
    (folder / "curve.csv").write_text(text)
    assert message in refused("evaluate", folder / "run", "--force", f"{folder / 'curve.csv'}{column}")


def test_a_curve_by_a_parameter_has_its_unit_in_the_header(folder, capsys):
    places = np.linspace(-60.0, 60.0, 241)
    lines = [f"{x},{1.3 * pull(1e-3 * x):.9f}" for x in places if x > -15.0]  # above, the force grows with the arch
    (folder / "curve.csv").write_text("\n".join(["arch_mm,force", *lines]) + "\n")
    assert main(["evaluate", str(folder / "run"), "--force", str(folder / "curve.csv")]) == 0
    values = dict(part.split("=") for part in capsys.readouterr().out.splitlines()[-1].split())
    # The file is straight between points 0.5 mm apart.
    assert float(values["factor"]) == pytest.approx(1.3, rel=1e-3)
