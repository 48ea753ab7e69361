"""Landmarks corrected by the outline in their frame, on rendered images of known states."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import Parameter, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import AtBound, OutlineContradicts, OutlineInexact, OutlineUnseen
from tests.integration.test_outline_beside_texture import CAMERA as BEFORE_BLOCK, SpottedFilm, state as block_state
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, colours, mean_error, sheet_state

MODEL = bent_sheet_model(22, 16)
CLICKS = 12


def clicked(state, seed, sigma_px=1.5, model=MODEL, camera=CAMERA):
    """Landmarks on nodes of an object, as a hand sets them."""
    rng = np.random.default_rng(seed)
    nodes = rng.choice(len(model.nodes), CLICKS, replace=False)
    pixels = camera.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    return Landmarks(model.nodes[nodes], pixels + sigma_px * rng.standard_normal((CLICKS, 2)))


def pose_and_parameter_errors(found, truth):
    """Errors of the parameters and the translation in their stated standard deviations."""
    away = [
        found.state.parameters - truth.parameters,
        found.state.camera_from_object.translation - truth.camera_from_object.translation,
    ]
    std = np.sqrt(np.diag(found.covariance))
    return np.concatenate(away) / np.concatenate([std[: len(away[0])], std[-3:]])


def test_the_outline_takes_out_most_of_what_clicks_are_off_by():
    before, after, in_deviations = [], [], []
    for seed in range(8):
        truth = sheet_state(0.12 * seed)
        image, landmarks = SheetFilm(MODEL, seed=seed).frame(truth), clicked(truth, seed)
        alone = register_landmarks(MODEL, CAMERA, landmarks)
        snapped = register_landmarks(MODEL, CAMERA, landmarks, image=image)
        assert snapped.facts["corrected_by_outline"]
        before.append(1e3 * mean_error(MODEL, alone.state, truth))
        after.append(1e3 * mean_error(MODEL, snapped.state, truth))
        in_deviations.append(pose_and_parameter_errors(snapped, truth))
    assert np.mean(before) > 3.0
    assert np.mean(after) < 0.2 * np.mean(before)
    assert 0.5 < np.sqrt(np.mean(np.square(in_deviations))) < 1.6


def test_an_outline_that_is_off_as_a_whole_leaves_errors_as_large_as_stated():
    """All edges are a quarter of a pixel too far inwards, which has the block a millimetre farther off.

    A tenth of a pixel is the deviation of that, so that 2.5 are expected, as in tests of the tracker.
    """
    film, truth = SpottedFilm(150, 3, gamma=2.2), block_state(0.0)
    landmarks = clicked(truth, 3, 1.0, film.model, BEFORE_BLOCK)
    found = register_landmarks(film.model, BEFORE_BLOCK, landmarks, image=film.frame(truth))
    assert found.facts["corrected_by_outline"]
    assert 2.0 < pose_and_parameter_errors(found, truth)[-1] < 3.2


@pytest.mark.parametrize("seed", [8, 9, 10, 30, 32, 34])
def test_a_state_that_misses_part_of_the_outline_does_not_fit_best(seed):
    """Nearly flat sheets, whose landmarks hardly tell to which side they bend: up to 23 mm off where that misled."""
    truth = sheet_state(0.12 * (seed % 10))
    image, landmarks = SheetFilm(MODEL, seed=seed).frame(truth), clicked(truth, seed)
    found = register_landmarks(MODEL, CAMERA, landmarks, image=image)
    assert mean_error(MODEL, found.state, truth) < 1e-3


def with_modulus(model):
    """The model with one more parameter, which no image shows: of a ratio that changes no displacement."""
    known = model.displacement.functions
    lower, upper = known.bounds
    indices = np.column_stack([known.multi_indices, np.zeros(len(known.multi_indices), dtype=np.int64)])
    functions = ParameterFunctions(np.append(lower, -1.0), np.append(upper, 1.0), indices, known.coefficients)
    modulus = Parameter("modulus", "ratio", "1", -1.0, 1.0, 0.0, "acts on the stress alone")
    field = SeparatedField(model.displacement.modes, functions)
    return replace(model, parameters=(*model.parameters, modulus), displacement=field, stresses={})


def test_what_neither_landmarks_nor_outline_show_is_not_known_beside_the_outline():
    truth, arch = sheet_state(0.3), bent_sheet_model(22, 16, known=1)
    truth = replace(truth, parameters=truth.parameters[:1])
    image, landmarks = SheetFilm(arch).frame(truth), clicked(truth, seed=1, sigma_px=0.7, model=arch)
    without = register_landmarks(arch, CAMERA, landmarks, image=image)
    found = register_landmarks(with_modulus(arch), CAMERA, landmarks, image=image)
    assert found.facts["corrected_by_outline"]
    assert found.state.parameters[1] == pytest.approx(0.0, abs=1e-6)
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations[1] > 2.0  # more than its range
    np.testing.assert_allclose(np.delete(deviations, 1), np.sqrt(np.diag(without.covariance)), rtol=0.3)
    assert not any(isinstance(warning, AtBound) for warning in found.warnings)


def with_margin(margin):
    """The sheet with a margin all around that its mesh does not have."""
    sides = np.abs(MODEL.nodes) > [0.2099, 0.1484, 1.0]
    return replace(MODEL, nodes=MODEL.nodes + margin * sides * np.sign(MODEL.nodes))


@pytest.mark.parametrize(
    ("seed", "why"), [(2, OutlineContradicts), (5, OutlineContradicts), (10, OutlineInexact), (18, OutlineUnseen)]
)
def test_a_sheet_that_is_larger_than_its_mesh_is_left_to_the_landmarks(seed, why):
    truth = sheet_state(0.3)
    image, landmarks = SheetFilm(with_margin(0.006)).frame(truth), clicked(truth, seed, sigma_px=0.5)
    alone = register_landmarks(MODEL, CAMERA, landmarks)
    found = register_landmarks(MODEL, CAMERA, landmarks, image=image)
    assert why in [type(warning) for warning in found.warnings]
    np.testing.assert_array_equal(found.state.parameters, alone.state.parameters)


@pytest.mark.parametrize("grey", [0.0, 130.0])
def test_an_image_without_the_object_corrects_nothing(grey):
    truth = sheet_state(0.3)
    image = colours(np.full((CAMERA.height, CAMERA.width), grey))
    found = register_landmarks(MODEL, CAMERA, clicked(truth, 2), image=image)
    assert OutlineUnseen in [type(warning) for warning in found.warnings]
    assert mean_error(MODEL, found.state, register_landmarks(MODEL, CAMERA, clicked(truth, 2)).state) == 0.0


def test_an_undeformed_object_stays_so():
    truth = replace(sheet_state(0.4), parameters=MODEL.default)
    image, landmarks = SheetFilm(MODEL).frame(truth), clicked(truth, 3)
    alone = register_landmarks(MODEL, CAMERA, landmarks, at_rest=True)
    found = register_landmarks(MODEL, CAMERA, landmarks, at_rest=True, image=image)
    np.testing.assert_array_equal(found.state.parameters, MODEL.default)
    np.testing.assert_array_equal(found.covariance[: len(MODEL.default)], 0.0)
    assert mean_error(MODEL, found.state, truth) < 0.3 * mean_error(MODEL, alone.state, truth)


#: The same field in twice as many pixels, in which landmarks may be off by 8 px before they are refused.
FINE = Camera(2 * CAMERA.width, 2 * CAMERA.height, 2 * CAMERA.fx, 2 * CAMERA.fy, 2 * CAMERA.cx, 2 * CAMERA.cy)


@pytest.mark.parametrize(("shift_px", "is_corrected"), [(0.0, True), (12.0, False)])
def test_an_outline_beside_landmarks_of_a_part_that_differs_from_its_mesh_does_not_decide(shift_px, is_corrected):
    """They fit to 3.5 px and the outline has them elsewhere: that counts by squares, however far off they are."""
    truth = replace(sheet_state(0.4), parameters=MODEL.default)
    pose, rng = truth.camera_from_object, np.random.default_rng(2)
    nodes = rng.choice(len(MODEL.nodes), CLICKS, replace=False)
    pixels = FINE.project(pose.apply(MODEL.nodes[nodes])) + 3.5 * rng.standard_normal((CLICKS, 2))
    aside = pose.translation + np.array([shift_px / FINE.fx * pose.translation[2], 0.0, 0.0])
    image = SheetFilm(MODEL, FINE).frame(replace(truth, camera_from_object=replace(pose, translation=aside)))
    found = register_landmarks(MODEL, FINE, Landmarks(MODEL.nodes[nodes], pixels), at_rest=True, image=image)
    assert found.facts["corrected_by_outline"] is is_corrected
    assert (OutlineContradicts in [type(warning) for warning in found.warnings]) is not is_corrected


def test_a_parameter_at_rest_is_not_at_a_bound_though_its_range_begins_there():
    arch = MODEL.parameters[0]
    one_sided = replace(MODEL, parameters=(replace(arch, lower=arch.default), *MODEL.parameters[1:]))
    truth = replace(sheet_state(0.4), parameters=MODEL.default)
    image, landmarks = SheetFilm(MODEL).frame(truth), clicked(truth, 3)
    found = register_landmarks(one_sided, CAMERA, landmarks, at_rest=True, image=image)
    assert found.facts["corrected_by_outline"]
    assert not any(isinstance(warning, AtBound) for warning in found.warnings)
