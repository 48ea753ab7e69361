"""An analytic reduced model of a bent A3 sheet, exact to rounding, for tests that need a model at once.

With s = 2x/L in [-1, 1], arch height a, skewness k and end twist q, the deflection is
w = a (1 - s²)(1 + k s) + q s y, and the in-plane displacement undoes the von Kármán strains
½ w,x² and ½ q² s², so that the sheet keeps its length along x to second order:
u = -∫₀ˣ ½ w,x² dx, v = -½ q² s² y. All terms are monomials in (a, k, q), so the model is separated exactly.
"""

from __future__ import annotations

from math import radians

import numpy as np

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

LENGTH, WIDTH = 0.420, 0.297
YOUNG_MODULUS, POISSON_RATIO, THICKNESS = 3e9, 0.3, 1e-4
PARAMETERS = (
    Parameter("arch", "length", "mm", -0.060, 0.060, 0.0, "height of the arch"),
    Parameter("skew", "ratio", "1", -0.6, 0.6, 0.0, "lean of the arch towards one end"),
    Parameter("twist", "angle", "deg", -radians(20), radians(20), 0.0, "twist of each end"),
)


def deflection_terms(x, y):
    """Displacement terms: powers of (arch, skew, twist) -> field (n, 3) at rest points."""
    s = 2.0 * x / LENGTH
    zero = np.zeros_like(x)
    arch, lean = 1.0 - s**2, s * (1.0 - s**2)
    return {
        (1, 0, 0): np.column_stack([zero, zero, arch]),
        (1, 1, 0): np.column_stack([zero, zero, lean]),
        (0, 0, 1): np.column_stack([zero, zero, s * y]),
        (2, 0, 0): np.column_stack([-(4 * s**3 / 3) / LENGTH, zero, zero]),
        (2, 1, 0): np.column_stack([(2 * s**2 - 3 * s**4) / LENGTH, zero, zero]),
        (2, 2, 0): np.column_stack([-(s - 2 * s**3 + 9 * s**5 / 5) / LENGTH, zero, zero]),
        (1, 0, 1): np.column_stack([-2 * y / LENGTH * (arch - 1.0), zero, zero]),
        (1, 1, 1): np.column_stack([-2 * y / LENGTH * lean, zero, zero]),
        (0, 0, 2): np.column_stack([-2 * y**2 / LENGTH**2 * x, -0.5 * s**2 * y, zero]),
    }


def bending_stress_terms(x, y):
    """Stress terms on the top face (n, 3): -E z / (1 - nu²) (w,xx + nu w,yy) and so on, z = thickness / 2."""
    s = 2.0 * x / LENGTH
    zero = np.zeros_like(x)
    factor = YOUNG_MODULUS * THICKNESS / 2 / (1 - POISSON_RATIO**2)
    curvature, lean = -8.0 / LENGTH**2 + zero, -24.0 * s / LENGTH**2
    return {
        (1, 0, 0): -factor * np.column_stack([curvature, POISSON_RATIO * curvature, zero]),
        (1, 1, 0): -factor * np.column_stack([lean, POISSON_RATIO * lean, zero]),
        (0, 0, 1): -factor * (1 - POISSON_RATIO) * np.column_stack([zero, zero, zero + 2.0 / LENGTH]),
    }


def _separated(terms, parameters):
    """A separated field from monomials; the box is symmetric, so x² = X² (T0 + T2) / 2 in each factor."""
    upper = np.array([p.upper for p in parameters])
    multi_indices, rows = [], []
    for mode, powers in enumerate(terms):
        expansion = {(): 1.0}
        for power, bound in zip(powers, upper, strict=True):
            factors = {0: {0: 1.0}, 1: {1: bound}, 2: {0: bound**2 / 2, 2: bound**2 / 2}}[power]
            expansion = {
                (*index, degree): value * factor
                for index, value in expansion.items()
                for degree, factor in factors.items()
            }
        for index, value in expansion.items():
            multi_indices.append(index)
            rows.append(value * np.eye(len(terms))[mode])
    functions = ParameterFunctions(-upper, upper, np.array(multi_indices, dtype=np.int64), np.array(rows))
    return SeparatedField(np.ascontiguousarray(np.stack(list(terms.values()))), functions)


def grid_triangles(columns, rows):
    """Triangles (m, 3) of a grid of nodes, row after row, two in a cell."""
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def sheet_mesh(columns=43, rows=31):
    """Nodes (n, 3) and triangles (m, 3) of the flat sheet, centred, in the plane z = 0, metres."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns) * LENGTH, np.linspace(-0.5, 0.5, rows) * WIDTH)
    nodes = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return nodes, grid_triangles(columns, rows)


def bent_sheet_model(columns=43, rows=31, known=3):
    """The reduced model: parameters arch (mm), skew (1), twist (deg); stress on both faces.

    ``known`` of them are in the model; the others stay 0 in it.
    """
    nodes, triangles = sheet_mesh(columns, rows)
    x, y = nodes[:, 0], nodes[:, 1]
    parameters = PARAMETERS[:known]

    def restricted(terms):
        return {powers[:known]: field for powers, field in terms.items() if not any(powers[known:])}

    stress = restricted(bending_stress_terms(x, y))
    return ReducedModel(
        name="bent sheet",
        nodes=nodes,
        triangles=triangles,
        parameters=parameters,
        displacement=_separated(restricted(deflection_terms(x, y)), parameters),
        stresses={
            "top": _separated(stress, parameters),
            "bottom": _separated({key: -value for key, value in stress.items()}, parameters),
        },
    )
