"""Thick sphere of incompressible neo-Hookean rubber under inner pressure, through its limit point.

With A and B the radii, a = lambda_a A and b those of the deformed sphere and f(l) = 2/l + 1/(2 l^4),
equilibrium gives p / mu = f(lambda_b) - f(lambda_a) (Green and Zerna, Theoretical Elasticity, 1954, section
3.10).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.mechanics.loads import FollowerPressure
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.arc_length import ArcLength, ArcOptions
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.mechanics.supports import PrescribedDisplacement
from morph_dslam.meshing.meshes import Mesh
from tests.support.solids import load_parameter, mapped_block, merged

INNER, OUTER, SHEAR = 0.1, 0.2, 1e6


def octant(cell_type: str, divisions: tuple[int, int, int]) -> Mesh:
    """Three blocks, each over a third of the octant; "z_min" of a block is the inner surface."""
    parts = []
    for turn in range(3):

        def place(unit: np.ndarray, turn: int = turn) -> np.ndarray:
            # Equal angles, not equal lengths, keep the cells of even size.
            u, v = np.tan(np.pi / 4.0 * unit[:, 0]), np.tan(np.pi / 4.0 * unit[:, 1])
            direction = np.column_stack([u, v, np.ones(len(u))])
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            radius = INNER * (OUTER / INNER) ** unit[:, 2]
            return np.roll(radius[:, None] * direction, turn, axis=1)

        parts.append(mapped_block(divisions, cell_type, place))
    mesh = merged(parts)
    planes = {f"plane_{axis}": np.flatnonzero(mesh.nodes[:, i] < 1e-9) for i, axis in enumerate("xyz")}
    return replace(mesh, node_sets=planes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell_type", "divisions", "mixed", "tolerance"),
    [("hex27", (2, 2, 2), True, 2e-3), ("hex8", (4, 4, 4), None, 0.01)],
)
def test_pressure_passes_its_maximum(
    cell_type: str, divisions: tuple[int, int, int], mixed: bool | None, tolerance: float
) -> None:
    symbols = load_parameter(pressure=0.0)
    mesh = octant(cell_type, divisions)
    # Poisson's ratio 0.4999: 5000 times stiffer in volume than in shear.
    material = NeoHookean(young=2.0 * SHEAR * 1.4999, poisson=0.4999)
    problem = SolidProblem(
        mesh,
        {"all": material},
        [PrescribedDisplacement(f"plane_{axis}", **{axis: 0.0}) for axis in "xyz"],
        [FollowerPressure("z_min", SHEAR * symbols["pressure"])],
        symbols,
        SolidOptions(mixed=mixed),
    )
    inner = int(np.argmin(np.linalg.norm(mesh.nodes - [INNER, 0.0, 0.0], axis=1)))

    def stretch(state: State) -> float:
        return 1.0 + problem.nodal_displacement(state.dofs)[inner, 0] / INNER

    path = ArcLength(problem, options=ArcOptions(first=0.02, largest=0.2))
    state, pressures = problem.initial_state(), []
    expected = {1.5: 0.755433, 2.0: 0.806927, 3.0: 0.634507}
    for target, pressure in expected.items():
        sense = 1.0 if target <= 2.0 else -1.0
        points = list(path.follow(state, lambda s, target=target: stretch(s) - target, sense))
        state = points[-1].state
        pressures += [point.state.mu[0] for point in points]
        assert stretch(state) == pytest.approx(target, rel=1e-6)
        assert state.mu[0] == pytest.approx(pressure, rel=tolerance)
        radii = np.linalg.norm(mesh.nodes + problem.nodal_displacement(state.dofs), axis=1)
        outer = radii[mesh.surface_nodes("z_max")]
        np.testing.assert_allclose(outer, OUTER * (1.0 + (target**3 - 1.0) / 8.0) ** (1.0 / 3.0), rtol=tolerance)
    assert max(pressures) > 0.8
