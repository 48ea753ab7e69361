"""Shapes that vary within the windows by which points are measured: a window shows the mean of what moves in it."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import sheet_mesh
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm

POSE = RigidTransform(UPRIGHT, np.array([0.0, 0.0, 0.62]))
LARGEST = 4e-3


def rippled_sheet(wavelength):
    """A sheet that ripples in its plane, along x; its parameter is the amplitude, metres."""
    nodes, triangles = sheet_mesh(85, 31)
    ripple = np.zeros((1, len(nodes), 3))
    ripple[0, :, 0] = np.sin(2.0 * np.pi * nodes[:, 0] / wavelength)
    ends = np.array([LARGEST])
    functions = ParameterFunctions(-ends, ends, np.array([[1]]), ends[:, None])
    amplitude = Parameter("ripple", "length", "mm", -LARGEST, LARGEST, 0.0, "amplitude in the plane")
    return ReducedModel("sheet", nodes, triangles, (amplitude,), SeparatedField(ripple, functions), {})


@pytest.mark.parametrize("wavelength_px", [60.0, 90.0])
def test_a_ripple_that_comes_from_one_frame_to_the_next_is_measured_whole(wavelength_px):
    """After one comparison up to a twentieth of it was missing, six standard deviations, and came with later frames.

    Where the texture is drawn between pixels, bilinear interpolation of the reference picture added as much again.
    """
    model = rippled_sheet(wavelength_px * 0.62 / CAMERA.fx)
    film, errors = SheetFilm(model), []
    flat = State(np.zeros(1), POSE)
    tracker = Tracker(model, CAMERA, Registration(model, flat), reference=film.frame(flat))
    for amplitude in (1.5e-3, 0.0, -1.5e-3, 0.5e-3):
        found = tracker.track(film.frame(State(np.array([amplitude]), POSE))).estimate
        errors.append((found.state.parameters[0] - amplitude) / found.parameter_std[0])
    assert np.abs(errors).max() < 4.0
