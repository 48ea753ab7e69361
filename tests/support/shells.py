"""Small shells for tests, written as study files, and the published tables that shells are compared with."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.shell_problem import ShellProblem
from morph_dslam.mechanics.solvers.continuation import advance, loaded_state
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.study import make_study

Array = NDArray[np.float64]


@dataclass
class SolvedShell:
    """A shell and one of its solutions."""

    problem: ShellProblem
    state: State

    def field(self, name: str) -> Array:
        """One of the fields at all nodes."""
        return self.problem.sample(self.state.dofs, self.state.mu)[name]

    def displacement(self, name: str) -> Array:
        """Mean displacement (3,) of a set, m."""
        return self.field("displacement")[self.problem.mesh.set_nodes(name)].mean(axis=0)

    def at(self, *mu: float) -> SolvedShell:
        """The solution at other parameters, followed from this one."""
        return SolvedShell(self.problem, advance(self.problem, self.state, np.array(mu))[-1])


def shell_study(text: str) -> ShellStudy:
    """A study from its text; a parameter without use is added if there is none, and a name."""
    content = tomllib.loads(text)
    content.setdefault("parameters", {"idle": {"range": [0.0, 1.0]}})
    study = make_study(content | {"name": "shell"})
    assert isinstance(study, ShellStudy)
    return study


def solved_shell(text: str) -> SolvedShell:
    """The solution at the parameters' defaults."""
    study = shell_study(text)
    problem = study.problem()
    return SolvedShell(problem, loaded_state(problem, study.root()))


#: Sze, Liu and Lo, Finite Elements in Analysis and Design 40, 2004, 1551-1569: part of the largest load, displacements
#: in the unit of length of the problem. Cantilever under end shear (table 1): -U and W of the tip.
CANTILEVER = {0.25: (0.563, 3.015), 0.5: (1.604, 4.933), 0.75: (2.541, 6.031), 1.0: (3.286, 6.698)}
#: Hemisphere with a hole of 18 degrees under alternating radial forces: outwards and inwards displacement.
HEMISPHERE = {0.1: (1.499, 1.840), 0.25: (2.596, 3.833), 0.5: (3.406, 5.902), 0.75: (3.816, 7.234)}
HEMISPHERE[1.0] = 4.067, 8.178
#: Slit annular plate under a line load: W of the inner and of the outer corner of the loaded end.
SLIT_PLATE = {
    0.1: (4.277, 5.876),
    0.25: (7.602, 10.288),
    0.5: (10.468, 13.768),
    0.75: (12.31, 15.842),
    1.0: (13.891, 17.528),
}

CANTILEVER_STUDY = """
mesh = {{ generator = "plate", size = ["100 mm", "10 mm"], divisions = [{n}, 1], cells = "{cells}" }}
shell = {{ thickness = "1 mm" }}
material = {{ young = "1.2e6 MPa", poisson = 0.0 }}
supports = [{{ kind = "clamped", on = "x_min" }}]
loads = [{{ kind = "edge", on = "x_max", force = ["0 N/m", "0 N/m", "40 N/mm * part"] }}]
parameters = {{ part = {{ range = [0.0, 1.0] }} }}
"""
HEMISPHERE_STUDY = """
shell = {{ thickness = "0.04 mm" }}
material = {{ young = "6.825e7 MPa", poisson = 0.3 }}
supports = [
    {{ kind = "symmetry", on = "start", axis = "y" }},
    {{ kind = "symmetry", on = "end", axis = "x" }},
    {{ kind = "displacement", on = "outwards", z = "0 mm" }},
]
loads = [
    {{ kind = "point", on = "outwards", force = ["200 N * part", "0 N", "0 N"] }},
    {{ kind = "point", on = "inwards", force = ["0 N", "-200 N * part", "0 N"] }},
]

[mesh]
generator = "sphere"
radius = "10 mm"
polar_angles = ["18 deg", "90 deg"]
angles = ["0 deg", "90 deg"]
divisions = [{n}, {n}]
cells = "{cells}"

[sets]
outwards.nearest = ["10 mm", "0 mm", "0 mm"]
inwards.nearest = ["0 mm", "10 mm", "0 mm"]

[parameters.part]
range = [0.0, 1.0]
"""
SLIT_PLATE_STUDY = """
shell = {{ thickness = "0.03 mm" }}
material = {{ young = "21e6 MPa", poisson = 0.0 }}
supports = [{{ kind = "clamped", on = "start" }}]
loads = [{{ kind = "edge", on = "end", force = ["0 N/m", "0 N/m", "0.8 N/mm * part"] }}]

[mesh]
generator = "annulus"
inner_radius = "6 mm"
outer_radius = "10 mm"
divisions = [{across}, {around}]
cells = "{cells}"
slit = true

[parameters.part]
range = [0.0, 1.0]
"""
#: Semi-cylinder clamped at one end, pinched at the middle of the other: deflection under the load (table 6).
PINCHED = {0.1: 16.1, 0.2: 37.582, 0.3: 66.410, 0.4: 113.704, 0.5: 132.653, 0.75: 156.584, 1.0: 171.505}
#: Half of it.
PINCHED_STUDY = """
shell = {{ thickness = "3 mm" }}
material = {{ young = "2068.5 MPa", poisson = 0.3 }}
supports = [
    {{ kind = "clamped", on = "bottom" }},
    {{ kind = "symmetry", on = "start", axis = "y" }},
    {{ kind = "symmetry", on = "end", axis = "x" }},
]
loads = [{{ kind = "point", on = "middle", force = ["0 N", "-1000 N * part", "0 N"] }}]

[mesh]
generator = "cylinder"
radius = "101.6 mm"
length = "304.8 mm"
angles = ["0 deg", "90 deg"]
divisions = [{along}, {around}]
cells = "{cells}"

[sets]
middle.nearest = ["0 mm", "101.6 mm", "304.8 mm"]

[parameters.part]
range = [0.0, 1.0]
"""
