"""A printed block turns until nothing of what the first view showed is seen, deforms, and turns back."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.observability import position_std
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import OtherReferenceView
from morph_dslam.tracking.state import moved
from morph_dslam.tracking.tracker import Tracker
from tests.support.rendered_sequence import CAMERA, mean_error
from tests.support.turning_block import BlockFilm, block_state

FRAMES = 90
#: There by 150 degrees, and back.
TURNS = np.radians(150) * np.interp(np.arange(1, FRAMES + 1), [0, FRAMES / 2, FRAMES], [0.0, 1.0, 0.0])
TRUTHS = [block_state(turn, (k + 1) / FRAMES) for k, turn in enumerate(TURNS)]
#: The same without the twist: what is one over the sequence.
UNTWISTED = [replace(truth, parameters=truth.parameters * [1.0, 0.0]) for truth in TRUTHS]
FAR_SIDE = np.degrees(TURNS) > 100


def tracked(truths=TRUTHS, step=None, covariance=None, **options):
    """The film, and what was found in its frames; the first view is off by ``step`` (8,)."""
    film, start = BlockFilm(), block_state(0.0, 0.0)
    state = start if step is None else moved(start, step)
    tracker = Tracker(
        film.model,
        CAMERA,
        Registration(film.model, state, covariance),
        TrackerOptions(**options),
        reference=film.frame(start),
    )
    return film, [tracker.track(film.frame(truth)) for truth in truths]


def errors_and_deviations(film, results, truths=TRUTHS):
    """Mean error of all nodes, root mean square, and the stated deviation of that (f,), metres."""
    found = []
    for result, truth in zip(results, truths, strict=True):
        assert result.status == "tracked", result.reason
        estimate, model = result.estimate, film.model
        apart = truth.camera_from_object.apply(model.positions(truth.parameters))
        apart = apart - estimate.state.camera_from_object.apply(model.positions(estimate.state.parameters))
        stated = np.sqrt(np.mean(position_std(model, estimate) ** 2))
        rms = np.sqrt(np.mean(np.sum(apart**2, axis=1)))
        found.append((mean_error(model, estimate.state, truth), rms, stated))
    return np.array(found).T


@pytest.mark.slow
def test_with_one_view_the_block_is_lost_on_its_far_side():
    _, results = tracked(new_views=False)
    lost = np.array([result.estimate is None for result in results])
    assert lost[FAR_SIDE].all()
    assert results[-1].status == "tracked"
    assert not any(result.made_view for result in results)


def test_with_new_views_it_is_followed_all_around_and_the_first_view_takes_the_drift_away():
    film, results = tracked()
    mean, rms, stated = errors_and_deviations(film, results)
    assert mean.mean() < 0.25e-3
    assert mean.max() < 1.2e-3
    assert mean[-10:].mean() < 0.2e-3  # nothing is left of what had accumulated
    ratio = rms / stated
    assert np.median(ratio) < 1.2
    assert np.quantile(ratio, 0.95) < 2.6
    views = np.array([result.view for result in results])
    assert (views[FAR_SIDE] > 0).all()
    assert (views[:5] == 0).all()
    assert (views[-5:] == 0).all()
    assert 2 <= sum(result.made_view for result in results) <= 4
    assert results[int(np.argmax(views == 1))].warning(OtherReferenceView).number == 1


@pytest.mark.slow
@pytest.mark.parametrize(("truths", "kept"), [(TRUTHS, ()), (UNTWISTED, ("twist",))])
def test_an_error_of_the_first_view_is_in_the_deviations_of_all(truths, kept):
    """The first view's state is off by one standard deviation in every unknown."""
    deviations = np.array([4e-4, 4e-3, 2e-3, 2e-3, 2e-3, 2e-4, 2e-4, 1e-3])
    step = deviations * [1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0]
    film, results = tracked(truths, step, np.diag(deviations**2), per_sequence=kept)
    _, rms, stated = errors_and_deviations(film, results, truths)
    assert np.quantile(rms / stated, 0.95) < 1.96
    # What is found by later views is not surer than the view that they come from.
    assert stated[FAR_SIDE].min() > 0.8 * stated[:5].mean()
