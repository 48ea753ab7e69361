"""What is not as it should be leads to a stated status, never to a confident wrong answer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import UnusualSize, WrongUnit
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.outcomes import ModelDoesNotExplain, OtherReferenceView
from tests.support.staged_scenes import SCENES, aside, drawn_out, is_beyond, is_doubted
from tests.support.stated_cases import (
    Shown,
    behind_a_thing,
    covered,
    exchanged,
    in_unit,
    landmarks,
    moving,
    passing,
    placed_by_landmarks,
    run_case,
    stated,
)

WORLD = SimilarityTransform(1.0, np.eye(3), np.array([0.1, -0.2, 0.3]))


@pytest.fixture(scope="module")
def sheet():
    return SCENES["sheet"](0)


@pytest.fixture(scope="module")
def solid():
    return SCENES["wedge in the hand"](0)


def tracked(scene, shown, model=None, **options):
    model = model or scene.model
    return stated(lambda: run_case(scene, placed_by_landmarks(scene, model, 0), shown, **options))


@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_the_right_model_is_not_accused(name):
    scene = SCENES[name](0)
    found = tracked(scene, moving(scene, 40)[::4])
    assert (found.n_tracked, found.n_wrong) == (10, 0)
    accusing = ("the model leaves", "bound", "less certain")
    assert not any(word in line for line in found.said for word in accusing)
    assert found.largest_error < 5e-3


@pytest.mark.parametrize(("name", "other"), [("sheet", "crossed"), ("wedge in the hand", "twisting")])
def test_a_model_of_other_loads_is_accused_and_not_sure(name, other):
    scene = SCENES[name](0)
    found = tracked(scene, moving(scene, 80)[::4], scene.others[other])
    assert found.n_wrong == 0
    assert any("the model leaves up to" in line for line in found.said)


@pytest.mark.parametrize("factors", [(0.96, 1.0, 1.0), (1.0, 1.06, 1.0)])
def test_a_sheet_of_another_format_is_mostly_not_sure_of_itself(factors):
    """Its landmarks fit by a turn and a bend: it is off by centimetres, and most frames say so."""
    scene = SCENES["sheet"](1)
    found = tracked(scene, moving(scene, 80)[::4], drawn_out(scene.model, factors))
    assert found.largest_error > 15e-3
    assert found.n_wrong <= 3
    said = ("deviations are", "the model leaves up to")
    assert all(any(line.startswith(what) for line in found.said) for what in said)


@pytest.mark.parametrize("factor", [1000.0, 25.4, 10.0])
@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_a_mesh_in_another_unit_than_the_landmarks_is_named(name, factor):
    scene = SCENES[name](0)
    points, pixels = landmarks(scene, scene.model)
    with pytest.raises(RegistrationError, match=f"multiplied by {1 / factor:.4g}"):
        register_landmarks(in_unit(scene.model, factor), scene.stage.camera, Landmarks(points, pixels))


def test_landmarks_all_over_a_sheet_are_named_where_its_mesh_is_in_a_unit_somewhat_too_large(sheet):
    """They lie on a part of the larger sheet, and fit by a bend of it, so that nothing else would say so."""
    given = Landmarks(*landmarks(sheet, sheet.model))
    found = register_landmarks(in_unit(sheet.model, 2.54), sheet.stage.camera, given)
    (unit,) = (warning for warning in found.warnings if isinstance(warning, WrongUnit))
    assert (unit.meant, unit.taken, unit.factor) == ("centimetres", "inches", pytest.approx(1 / 2.54))
    right = register_landmarks(sheet.model, sheet.stage.camera, given)
    assert not any(isinstance(warning, WrongUnit) for warning in right.warnings)


def test_one_camera_cannot_tell_the_size_but_an_absurd_one_is_flagged(sheet):
    """Mesh and landmarks in the same wrong unit fit perfectly, at a distance as wrong as the size."""
    points, pixels = landmarks(sheet, sheet.model, click_px=0.0)
    model = in_unit(sheet.model, 1000.0)
    found = register_landmarks(model, sheet.stage.camera, Landmarks(1000.0 * points, pixels))
    assert UnusualSize(pytest.approx(514.0, abs=1.0)) in found.warnings
    depth = found.state.camera_from_object.translation[2]
    assert depth == pytest.approx(1000.0 * sheet.state(0.0).camera_from_object.translation[2], rel=1e-3)


@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_an_absent_object_is_lost_in_every_frame_with_a_reason(name):
    scene = SCENES[name](0)
    found = tracked(scene, [Shown(None)] * 4, in_sequence=False)
    assert (found.n_tracked, found.n_lost) == (0, 4)
    assert all("agree" in line or "frames were lost" in line for line in found.said)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sheet", "wedge in the hand"])
def test_an_object_covered_for_two_seconds_is_lost_and_found_again(name):
    scene = SCENES[name](0)
    frames, free_again = covered(scene, n_before=3, n_after=3)
    hidden = [k for k, view in enumerate(frames) if view.cover == 1.0]
    assert len(hidden) >= 60
    # Of the frames in which all is hidden every tenth will do.
    kept = [k for k in range(len(frames)) if frames[k].cover < 1.0 or k % 10 == 0]
    back_at = kept.index(free_again)
    found = tracked(scene, [frames[k] for k in kept], back_at=back_at)
    assert found.n_wrong == 0
    assert all(found.statuses[kept.index(k)] == "lost" for k in hidden if k in kept)
    assert found.back_after is not None
    assert found.back_after <= 1
    assert found.statuses[-1] == "tracked"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [("wedge in the hand", 1), ("wedge on a table", 0)])
def test_the_rim_of_what_covers_an_object_is_not_believed(name, seed):
    """Half covered within a frame, windows at the arm's rim agree with each other and with nothing else."""
    scene = SCENES[name](seed)
    frames, free_again = covered(scene, n_after=2)
    kept = [k for k in range(len(frames)) if frames[k].cover < 1.0 or k % 20 == 0]
    placed = placed_by_landmarks(scene, scene.model, seed)
    found = run_case(scene, placed, [frames[k] for k in kept], kept.index(free_again))
    assert found.n_wrong == 0
    assert found.back_after == 0
    # It is doubted, not given up: it was followed until half of the picture was covered.
    assert all(found.statuses[kept.index(k)] == "tracked" for k in kept if frames[k].cover < 0.5 and k < 10)


@pytest.mark.parametrize("nearer", [0.0, 0.5])
def test_another_one_that_passes_is_not_followed(sheet, nearer):
    found = tracked(sheet, passing(sheet, 60, nearer, 0.08 if nearer else 0.0)[::3])
    assert found.n_wrong == 0
    assert found.n_tracked == 20
    assert found.largest_error < 20e-3


@pytest.mark.slow
@pytest.mark.parametrize("width", [1.3, 0.35])
def test_what_looks_like_it_by_chance_on_a_cover_is_not_followed(width):
    """A print of the same kind before it: patches of it correlate with some of the object's."""
    scene = SCENES["wedge on a table"](0)
    shown, free = behind_a_thing(scene, 20, width)
    found = tracked(scene, shown, back_at=free)
    hidden = range(13, 32)
    assert all(found.statuses[k] == "lost" for k in hidden)
    assert found.n_wrong == 0
    assert found.back_after is not None
    assert found.back_after <= 1


@pytest.mark.slow
@pytest.mark.parametrize("like_it", [False, True])
def test_one_that_is_there_instead_is_found_only_if_it_has_the_print(sheet, like_it):
    shown, free = exchanged(sheet, like_it, n_after=6)
    kept = [k for k, view in enumerate(shown) if view.cover < 1.0 or k % 10 == 0]
    found = tracked(sheet, [shown[k] for k in kept], back_at=kept.index(free))
    assert found.n_wrong == 0
    assert (found.statuses[-1] == "tracked") == like_it


def test_wrong_and_confident_are_measured_as_stated(solid):
    """The measure itself: the truth shifted by 6 mm is wrong; what says that it does not know is not."""
    truth = solid.state(0.2)
    estimate = Estimate(truth, 0.0, np.empty((0, 2)), 0.1, 1e-10 * np.eye(8), np.zeros(2, dtype=bool), 1, True)
    result = SimpleNamespace(status="tracked", estimate=estimate)
    assert not is_beyond(solid.model, result, solid.model, truth)
    result.estimate = replace(estimate, state=aside(truth, [6e-3, 0.0, 0.0]))
    assert is_beyond(solid.model, result, solid.model, truth)
    in_doubt = np.diag([0, 0, 0, 0, 0, 5e-6, 0, 0.0])  # 2.2 mm
    result.estimate = replace(result.estimate, covariance=in_doubt)
    assert not is_beyond(solid.model, result, solid.model, truth)
    result.warnings = (OtherReferenceView(1),)
    assert not is_doubted(result)
    result.warnings += (ModelDoesNotExplain(0.7),)
    assert is_doubted(result)
