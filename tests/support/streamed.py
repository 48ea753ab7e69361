"""A block that a stream tells of, with reactions; its shape, stress and forces are known in closed form."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace

import numpy as np

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.sources import Frame
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.outcomes import FoundBy, Rejection, RejectionReason, Status
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.sinks import TrackedFrame
from tests.support.documents import PROJECT
from tests.support.rendered_sequence import CAMERA
from tests.support.stretched_block import PARAMETERS, SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model

#: Deviations of the parameters, the rotation vector and the translation.
DEVIATIONS = np.array([0.01, 5e-4, 0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3])
POSE = RigidTransform(rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([0.02, -0.01, 0.4]))


def held_block_model():
    """The block with the forces that hold its left end: 400 N for a strain of 1 along x, 5 N for each mm of slide."""
    model = stretched_block_model()
    upper = np.array([p.upper for p in PARAMETERS])
    functions = ParameterFunctions(-upper, upper, np.eye(2, dtype=np.int64), np.diag(upper))
    force = SeparatedField(np.array([[[-400.0, 0.0, 0.0]], [[0.0, 0.0, 5000.0]]]), functions)
    left = np.flatnonzero(model.nodes[:, 0] == 0.0)
    return replace(model, supports={"left end": left}, reactions={"force_left end": force})


def vertices_at(model, stretch, slide):
    """Deformed nodes (n, 3)."""
    x, y, z = model.nodes.T
    return np.column_stack([x + stretch * x + slide * z / SIZE[2], y, z])


def stress_at(stretch, slide):
    """Von Mises stress, the same everywhere."""
    return np.hypot(YOUNG_MODULUS * stretch, np.sqrt(3.0) * SHEAR_MODULUS * slide / SIZE[2])


def tracked_result(model, stretch, slide):
    """The block found in these parameters."""
    state = State(np.array([stretch, slide]), POSE)
    covariance = np.diag(DEVIATIONS**2)
    estimate = Estimate(state, 0.0, np.empty((0, 2)), 0.1, covariance, np.zeros(2, dtype=bool), 5, True)
    return FrameResult(model, Status.TRACKED, estimate, FoundBy.FLOW)


def lost_result(model):
    """The block lost."""
    return FrameResult(model, Status.LOST, rejection=Rejection(RejectionReason.FEW_POINTS, 4, 300, 30))


def tracked_frame(number, timestamp, **results):
    """Results by object, with a grey image."""
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    return TrackedFrame((Frame(number, timestamp, image),), results)


def stream_example(name):
    """A program of examples/streams as a module."""
    folder = PROJECT / "examples" / "streams"
    spec = importlib.util.spec_from_file_location(f"stream_example_{name}", folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(folder))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
    return module
