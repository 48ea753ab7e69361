"""Whether an object looks the same in several attitudes, and deforms the same in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.registration.icp import SYMMETRY_TOLERANCE, Surface
from morph_dslam.registration.messages import Ambiguity, Ambiguous, AttitudeArbitrary, RegistrationWarning
from morph_dslam.registration.registration import Axis
from morph_dslam.surface_distances import distances_to_surface

Array = NDArray[np.float64]
#: Parts of a turn by which a body may lie where it was.
PARTS = (2, 3, 4, 5, 6)
#: A point of a surface is hardly ever farther from its nearest sample.
FARTHEST_SPACINGS = 6.0
#: Cosine from which two axes are one.
ABOUT_THE_SAME = 0.99
#: Turned displacements are the same if they differ by less than this share of what they are, on average.
SAME_DISPLACEMENTS = 0.1
#: States of a model that are compared, and points of its surface.
N_STATES, N_POINTS = 6, 4000


def turn_warning(model: ReducedModel, axis: Axis | None) -> RegistrationWarning | None:
    """That a registration by shape alone may have the object turned, and whether that matters; None if it may not.

    Parameters
    ----------
    model : of the object.
    axis : of revolution of its surface, turns about which are no concern here; None if it has none.
    """
    nodes = model.positions(model.default)
    turns = turns_alike(nodes, model.triangles, axis)
    if not turns:
        return None
    for about, angle in turns:
        if not deforms_alike(model, about, angle):
            return Ambiguous(Ambiguity.TURNED, float(np.degrees(angle)))
    return AttitudeArbitrary(float(np.degrees(turns[0][1])))


def turns_alike(nodes: Array, triangles: NDArray[np.int64], axis: Axis | None) -> list[tuple[Axis, float]]:
    """Axes and angles (rad) by which a surface can be turned and lies where it was.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    axis : of revolution, about which no turns are tried.
    """
    surface = Surface.of_mesh(nodes, triangles)
    found = []
    for direction in surface.axes:
        if axis is not None and abs(direction @ axis.direction) > ABOUT_THE_SAME:
            continue
        about = Axis(surface.centre, direction)
        angles = (2.0 * np.pi / part for part in PARTS)
        found += [(about, angle) for angle in angles if _fits(about, angle, nodes, triangles, surface)]
    return found


def _fits(about: Axis, angle: float, nodes: Array, triangles: NDArray[np.int64], surface: Surface) -> bool:
    """Whether all of a surface, turned about an axis by an angle (rad), is on itself up to the tolerance."""
    allowed = SYMMETRY_TOLERANCE * surface.size
    # Samples of the surface, no farther apart than some spacings, decide for most nodes and most turns.
    spacing = float(np.median(surface.tree.query(surface.points[::10], k=2)[0][:, 1]))
    turned = about.turned(nodes[np.unique(triangles)], angle)
    off = surface.tree.query(turned)[0]
    if off.max() > allowed + FARTHEST_SPACINGS * spacing:
        return False
    return bool((distances_to_surface(turned[off > allowed], nodes, triangles) <= allowed).all())


def deforms_alike(model: ReducedModel, about: Axis, angle: float) -> bool:
    """Whether an object that is turned about an axis by an angle (rad) deforms as if it had not been turned."""
    rest, triangles = model.positions(model.default), model.triangles
    samples = spread_over(rest, triangles, N_POINTS)
    corners = triangles[samples.triangles]

    def on_points(values: Array) -> Array:
        return np.einsum("pc,pcx->px", samples.weights, values[corners])

    points = on_points(rest)
    nearest = KDTree(points).query(about.turned(points, angle))[1]
    turn = Axis(np.zeros(3), about.direction)
    for parameters in model.spread_parameters(N_STATES):
        moved = on_points(model.positions(parameters) - rest)
        apart = np.linalg.norm(turn.turned(moved, angle) - moved[nearest], axis=1).mean()
        if apart > SAME_DISPLACEMENTS * np.linalg.norm(moved, axis=1).mean():
            return False
    return True
