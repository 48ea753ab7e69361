"""The first use says that it takes long; later ones say nothing. What takes longest to compile is not used."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import morph_dslam
from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.tracking import BoundPoints, Estimator, State
from morph_dslam.model import SurfacePoints
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA

SOURCES = sorted(Path(morph_dslam.__file__).parent.rglob("*.py"))
#: numba takes from half a second to four to compile one of these, in each process that compiles a loop with it.
DEAR = {"append", "argsort", "cross", "diff", "median", "outer", "ptp", "solve", "where"}
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


def is_compiled(node):
    return isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(word) for word in node.decorator_list)


def dear_in(text):
    loops = [node for node in ast.walk(ast.parse(text)) if is_compiled(node)]
    calls = [node.func for loop in loops for node in ast.walk(loop) if isinstance(node, ast.Call)]
    return [ast.unparse(name) for name in calls if isinstance(name, ast.Attribute) and name.attr in DEAR]


def is_number(value):
    """Whether an expression names nothing but numpy's constants."""
    return {"np"}.issuperset(node.id for node in ast.walk(value) if isinstance(node, ast.Name))


def fills_a_part(step):
    """Whether an array or a tuple may go to a part of an array: numba compiles the message for shapes that differ."""
    targets = step.targets if isinstance(step, ast.Assign) else [step.target]
    places = [node.slice for target in targets for node in ast.walk(target) if isinstance(node, ast.Subscript)]
    if any(isinstance(node, ast.Slice) for place in places for node in ast.walk(place)):
        return isinstance(step, ast.AugAssign) or not is_number(step.value)
    return isinstance(step.value, ast.Tuple) and any(isinstance(target, ast.Subscript) for target in targets)


def parts_filled_in(text):
    loops = [node for node in ast.walk(ast.parse(text)) if is_compiled(node)]
    steps = [node for loop in loops for node in ast.walk(loop) if isinstance(node, (ast.Assign, ast.AugAssign))]
    return [ast.unparse(step) for step in steps if fills_a_part(step)]


def test_what_is_dear_is_found():
    text = "@njit(cache=True)\ndef loop(a):\n    return np.linalg.solve(a, a)\ndef other(a):\n    return np.median(a)"
    assert dear_in(text) == ["np.linalg.solve"]
    text = "@njit\ndef loop(a, b):\n    a[0, :] = b\n    a[:, 1] *= 2.0\n    a[1:, :] = -np.nan\n    a[0, 0] = b[0]"
    text += "\n    a[1] = 1.0, 2.0\n    a[1, 0], b[1] = 1.0, 2.0"
    assert parts_filled_in(text) == ["a[0, :] = b", "a[:, 1] *= 2.0", "a[1] = (1.0, 2.0)"]


@pytest.mark.parametrize("path", [path for path in SOURCES if "njit" in path.read_text(encoding="utf-8")], ids=str)
def test_compiled_loops_use_nothing_that_is_dear_to_compile(path):
    text = path.read_text(encoding="utf-8")
    assert not dear_in(text)
    assert not parts_filled_in(text)
