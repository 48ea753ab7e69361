"""A sheet with one half covered, and bent as its model is not: truth is known, as it is rendered."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.model import SeparatedField
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.observability import position_std
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import FewPointsAgree
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import WIDTH, bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

#: The cover reaches so many pixels beyond the sheet's edge.
BEYOND = 9


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


def curled(model, height):
    """The same sheet with its arch curled along y too, by ``height`` over an arch of 1 m."""
    across = (2.0 * model.nodes[:, 1] / WIDTH) ** 2
    modes = model.displacement.modes.copy()
    arch = int(np.abs(modes[:, :, 2]).sum(axis=1).argmax())
    modes[arch, :, 2] *= 1.0 + height * across
    return replace(model, displacement=SeparatedField(modes, model.displacement.functions))


def covered(image, model, state, sign):
    """The image with a grey cover over the half of the sheet whose y has this sign."""
    pixels = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))
    hull = cv2.convexHull(pixels[sign * model.nodes[:, 1] >= 0.0].astype(np.float32))
    mask = cv2.fillConvexPoly(np.zeros(image.shape[:2], np.uint8), np.rint(hull).astype(np.int32), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BEYOND + 1,) * 2)
    image[cv2.dilate(mask, disc) > 0] = 128
    return image


def followed(model, height, sign, **options):
    """Errors (f, n) of the nodes and their stated deviations in the frames that are tracked, metres, of 20."""
    truth, first = curled(model, height), sheet_state(0.0)
    film = SheetFilm(truth)
    registration = Registration(model, first)
    tracker = Tracker(model, CAMERA, registration, TrackerOptions(**options), reference=film.frame(first))
    errors, deviations = [], []
    for time in np.linspace(0.0, 0.8, 21)[1:]:
        state = sheet_state(time)
        estimate = tracker.track(covered(film.frame(state), truth, state, sign)).estimate
        if estimate is not None:
            found = estimate.state.camera_from_object.apply(model.positions(estimate.state.parameters))
            true = state.camera_from_object.apply(truth.positions(state.parameters))
            errors.append(np.linalg.norm(found - true, axis=1))
            deviations.append(position_std(model, estimate))
    return np.array(errors), np.array(deviations)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_edge_of_what_covers_a_sheet_is_not_taken_for_its_outline(model, sign):
    """Errors of the covered half: with the outline no larger than without it."""
    hidden = sign * model.nodes[:, 1] > 0.0
    without = followed(model, 0.3, sign)[0][:, hidden].mean()
    errors = followed(model, 0.3, sign, use_outline=True)[0]
    assert errors[:, hidden].mean() < 1.02 * without


def test_half_a_sheet_is_followed_that_its_model_does_not_quite_describe(model):
    """The model leaves more than a pixel of the half that is seen, but alike in neighbours: no frame is lost."""
    errors, deviations = followed(model, 1.0, 1.0)
    hidden = model.nodes[:, 1] > 0.0
    assert len(errors) == 20
    assert errors[:, hidden].mean() < 15e-3
    # The deviations that are stated say how far off it is.
    assert 0.5 < np.sqrt(np.mean((errors / deviations)[:, hidden] ** 2)) < 2.0


def with_shifted_tiles(texture, rng, tile=44, most=5):
    """The texture (h, w) in tiles that have moved by up to ``most`` pixels each."""
    padded = np.pad(texture, most, mode="edge")
    shifted = np.empty_like(texture)
    for top in range(0, texture.shape[0], tile):
        for left in range(0, texture.shape[1], tile):
            down, right = rng.integers(-most, most + 1, 2) + most
            height, width = texture[top : top + tile, left : left + tile].shape
            part = padded[top + down : top + down + height, left + right : left + right + width]
            shifted[top : top + tile, left : left + tile] = part
    return shifted


def test_points_that_agree_far_less_closely_than_before_are_named():
    """As where dots of a regular print are taken for their neighbours: nearly all agree, by pixels."""
    model, state = bent_sheet_model(22, 16), sheet_state(0.0)
    film, rng = SheetFilm(model), np.random.default_rng(1)
    tracker = Tracker(model, CAMERA, Registration(model, state), reference=film.frame(state))
    for _ in range(3):
        assert tracker.track(film.frame(state)).warning(FewPointsAgree) is None
    film.texture = with_shifted_tiles(film.texture, rng)
    result = tracker.track(film.frame(state))
    assert result.tracked
    assert result.n_inliers > 0.7 * result.n_points
    assert result.warning(FewPointsAgree) is not None
