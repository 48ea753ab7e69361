"""The first use says that it takes long; later ones say nothing."""

import os
import subprocess
import sys

import numpy as np

from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.tracking import BoundPoints, Estimator, State
from morph_dslam.model import SurfacePoints
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA

#: Twice, as a registration and a tracker do.
PROGRAM = """
from morph_dslam.tracking.compilation import announce_compilation
announce_compilation()
announce_compilation()
"""


def said(**environment):
    arguments = {"env": os.environ | environment, "capture_output": True, "text": True, "check": True}
    return subprocess.run([sys.executable, "-c", PROGRAM], **arguments).stderr


def test_compilation_is_announced_once_and_only_the_first_time(tmp_path):
    assert said(NUMBA_CACHE_DIR=str(tmp_path)).count("compiling the inner loops") == 1
    model = bent_sheet_model(3, 3)
    points = BoundPoints.from_surface(model, SurfacePoints(np.zeros(1, dtype=np.int64), np.full((1, 3), 1.0 / 3.0)))
    state = State(model.default, RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.0])))
    Estimator(model, CAMERA).evaluate(points, np.zeros((1, 2)), np.ones(1), state)
    assert said() == ""
