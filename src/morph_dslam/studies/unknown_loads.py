"""[unknown_loads] of a study: tractions that it does not foresee, and how the deformed body answers them.

The softest tractions on a surface (`mechanics.load_modes`) are found in several states and joined to one set. In states
spread over the parameters, the tangent then tells what each of them does: displacement, stress and reactions, which are
reduced like other fields. So the loads act linearly about every parametric state. The softest combinations of them move
the body to second order too, by the second derivative of the equations along what they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.load_modes import (
    SOFTLESS,
    LoadedSurface,
    common_tractions,
    pressing_tractions,
    softest_tractions,
)
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.model.functions import ParameterFunctions, total_degree_indices
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.unknown_loads import LEAST_COMPLIANCE, ROOT, SecondOrder, UnknownLoads, packed_root
from morph_dslam.reduction.pod import compute_pod
from morph_dslam.reduction.regression import design_matrix
from morph_dslam.studies.problem import ParametricStudy, bounds
from morph_dslam.studies.sections import UnknownLoadsSection
from morph_dslam.studies.snapshots import load_state
from morph_dslam.studies.solid_sweep import SolidSweep
from morph_dslam.studies.solutions import Snapshots

Array = NDArray[np.float64]
#: Most states in which the softest tractions are sought.
SOUGHT_IN = 6
#: States for each term of a polynomial of second order; the highest order tried, with this many terms a state.
STATES_A_TERM, HIGHEST_DEGREE, MOST_TERMS_A_STATE = 3, 4, 0.7
#: A load that acts to less than this share where the body can move acts on what supports hold.
ON_MOVING = 0.15
#: So many of the softest combinations of loads act to second order: a slender body bends to two sides, and twists.
SOFTEST = 3
#: Name of their displacements among the responses.
_SECOND = "second order"
#: Relative norm of the responses' fields that may be left out, and most functions of the parameters.
TOLERANCE, MOST_FUNCTIONS = 2e-2, 12


def reduce_unknown_loads(
    study: ParametricStudy, section: UnknownLoadsSection, snapshots: Snapshots
) -> tuple[UnknownLoads, dict[str, Any]]:
    """The unknown loads of a study's model, and what the certificate says of them.

    Raises
    ------
    StudyError
        If the study's kind of problem has no tangents to tell.
    """
    problem = snapshots.problem() if snapshots.problem is not None else None
    if not isinstance(problem, SolidSweep):
        raise StudyError(
            "[unknown_loads] is for elastic solids and shells that are solved here, not for viscoelastic ones: leave "
            "it out"
        )
    inward = section.direction == "inward"
    surface, samples = problem.loaded_surface(section.on, inward), _Samples(study, snapshots)
    states = [problem.unpack(load_state(file)) for file in samples.files[:SOUGHT_IN]]
    if inward:
        tractions = pressing_tractions(surface, snapshots.mesh.nodes, section.modes)
    else:
        found = [softest_tractions(surface, problem.response(state), section.modes) for state in states]
        tractions = common_tractions(surface, found, section.modes)
    compliance, changes = surface.compliance(tractions, problem.response(states[0]))
    energies = np.diag(compliance)
    # Loads at places that supports hold move nothing, and have no size that they could be measured by.
    moving = (energies > SOFTLESS * energies.max()) & (_moving_share(surface, tractions, changes) >= ON_MOVING)
    tractions = tractions[moving] / np.sqrt(energies[moving])[:, None, None]
    responses, soft = _responses(problem, surface, tractions, samples.files)
    nodal = surface.nodal(tractions)
    loaded = np.abs(nodal).max(axis=(0, 2)) > 0.0
    reduced = {name: samples.reduced(values) for name, values in responses.items()}
    second = reduced.pop(_SECOND, None)
    loads = UnknownLoads(
        section.on,
        inward,
        surface.nodes[loaded],
        np.ascontiguousarray(np.moveaxis(nodal[:, loaded], 0, 2)),
        surface.resultants(tractions),
        {name: field for name, (field, _) in reduced.items()},
        None if second is None else SecondOrder(soft, second[0]),
    )
    return loads, {
        "surface": section.on,
        "direction": section.direction,
        "loads": loads.count,
        "states": len(samples.files),
        "response_error": reduced["displacement"][1],
    }


def _responses(
    problem: SolidSweep, surface: LoadedSurface, tractions: Array, files: Sequence[Path]
) -> tuple[dict[str, list[NDArray]], Array]:
    """What tractions (m, a, k) do in each of the solved states, by field, and their softest combinations (s, m)."""
    found, soft, combined = dict[str, list[NDArray]](), np.empty(0), np.empty(0)
    for number, file in enumerate(tqdm(files, desc="responses to loads", unit="state")):
        state = problem.unpack(load_state(file))
        compliance, changes = surface.compliance(tractions, problem.response(state))
        fields = problem.response_fields(state, surface.loads(tractions), changes)
        if number == 0:
            soft, combined = softest_combinations(compliance, fields["displacement"])
        second = problem.second_order(state, combined @ changes)
        fields |= {} if second is None else {_SECOND: second}
        stacked = {name: np.moveaxis(part, 0, 1).reshape(part.shape[1], -1) for name, part in fields.items()}
        for name, values in (stacked | {ROOT: packed_root(compliance)[None]}).items():
            found.setdefault(name, []).append(values.astype(np.float32))
    return found, soft


def softest_combinations(compliance: Array, displacement: Array) -> tuple[Array, Array]:
    """The combinations of m loads that move the nodes most for the energy that they need.

    Parameters
    ----------
    compliance : (m, m), J.
    displacement : (m, n, 3) of the nodes by each load, metres.

    Returns
    -------
    soft : (s, m) to the coefficients of the combinations from those of the loads, in the sense of the energy.
    combined : (s, m) the loads' coefficients in each combination, whose energy is half a joule.
    """
    m = len(compliance)
    flat = displacement.reshape(m, -1)
    held = compliance + LEAST_COMPLIANCE * np.trace(compliance) / m * np.eye(m)
    _, vectors = scipy.linalg.eigh(flat @ flat.T, held, subset_by_index=[max(m - SOFTEST, 0), m - 1])
    return vectors.T @ held, vectors.T


def _moving_share(surface: LoadedSurface, tractions: Array, changes: Array) -> Array:
    """The part (c,) of tractions (c, a, k) that acts at dofs which any of their responses (c, n_dofs) moves."""
    loads = np.abs(surface.loads(tractions))
    return loads[:, (changes != 0.0).any(axis=0)].sum(axis=1) / loads.sum(axis=1)


class _Samples:
    """Solutions spread over the parameters, that nearest to the defaults first.

    Attributes
    ----------
    files : of the solutions.
    samples : (n, d) their parameters.
    """

    def __init__(self, study: ParametricStudy, snapshots: Snapshots) -> None:
        self._box, files = bounds(study), [*snapshots.training_files, *snapshots.held_out_files]
        known = np.array([np.load(file)["coordinates"] for file in files])
        widths = np.diff(self._box, axis=1)[:, 0]
        default = np.array([parameter.default for parameter in study.model_parameters()])
        first = int(np.linalg.norm((known - default) / widths, axis=1).argmin())
        count = STATES_A_TERM * len(total_degree_indices(len(widths), 2))
        chosen = farthest_points(known / widths, count, first)
        self.files, self.samples = [files[k] for k in chosen], known[chosen]

    def reduced(self, values: list[NDArray]) -> tuple[SeparatedField, float]:
        """A separated field of values (n, c) at the samples, and its relative error where one of them is left out."""
        flat = np.array([value.ravel() for value in values], dtype=float)
        pod = compute_pod(flat.copy(), np.full(flat.shape[1], 1.0 / flat.shape[1]), TOLERANCE, MOST_FUNCTIONS)
        coefficients = pod.project(flat)
        left_out = float(np.linalg.norm(coefficients @ pod.modes - flat) / np.linalg.norm(flat))
        functions, missed = self._fitted(coefficients)
        return SeparatedField(pod.modes.reshape(-1, *values[0].shape), functions), float(np.hypot(left_out, missed))

    def _fitted(self, coefficients: Array) -> tuple[ParameterFunctions, float]:
        """Polynomials of the total degree that predicts coefficients (m, r) of left-out samples best, and how well."""
        (lower, upper), best = self._box.T, (np.inf, np.empty((0, 0), dtype=np.int64), coefficients)
        for degree in range(HIGHEST_DEGREE + 1):
            indices = total_degree_indices(len(lower), degree)
            if len(indices) > MOST_TERMS_A_STATE * len(coefficients):
                break
            design = design_matrix(self.samples, lower, upper, indices)[0]
            orthogonal, triangle = np.linalg.qr(design)
            fitted = orthogonal @ (orthogonal.T @ coefficients)
            # What a sample is missed by if it is left out of a linear fit follows from its leverage.
            leverage = np.minimum(np.sum(orthogonal**2, axis=1, keepdims=True), 1.0 - 1e-6)
            missed = float(np.linalg.norm((fitted - coefficients) / (1.0 - leverage)) / np.linalg.norm(coefficients))
            if missed < best[0]:
                solved = np.linalg.solve(triangle, orthogonal.T @ coefficients)
                best = missed, indices, np.asarray(solved, dtype=np.float64)
        return ParameterFunctions(lower, upper, best[1], best[2]), best[0]
