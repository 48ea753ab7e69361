"""The discretisation error of a study's solutions: a few held-out ones are solved again with elements one order higher.

Viscous solids are followed again from the beginning, with half the increments of time besides.

States are chosen by their strain alone, before anything is solved. How many can be afforded, in a quarter of the
build's time or 20 seconds, follows from numbers of unknowns, so that it is the same in every run; the clock ends what
takes longer than foreseen, and the certificate says what was left out and why.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.loads import with_reactions
from morph_dslam.mechanics.shell_problem import ShellOptions, ShellProblem
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning
from morph_dslam.mechanics.solvers import newton
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.solvers.linear_solver import SolverMaker
from morph_dslam.mechanics.solvers.newton import Linearisation, State, size, solve
from morph_dslam.mechanics.solvers.two_level import LowerOrder, TwoLevelSolver
from morph_dslam.model import ReducedModel
from morph_dslam.model.parameter_errors import ENTRY, parameter_errors
from morph_dslam.model.reduced_model import REACTION
from morph_dslam.reduction.certificate import field_errors
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.problem import Snapshot, announce
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.shell_sweep import shell_snapshot
from morph_dslam.studies.snapshots import load_state
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solid_sweep import SolidSweep, solid_snapshot
from morph_dslam.studies.solutions import Snapshots
from morph_dslam.studies.study import Study
from morph_dslam.studies.viscous_sweep import ViscousSweep

Array = NDArray[np.float64]
#: Part of the whole build that the estimate may take, and seconds that it may take of any build: short ones consist of
#: more than solves, and whoever waits a minute would rather know.
SHARE, FLOOR = 0.25, 20.0
#: Part of that time at which no tangent is begun any more: the last one must end, and fields be recovered.
CLOCK = 0.8
MOST_BYTES = 4e9
#: Places of the states to solve again among the held-out ones sorted by strain, the first ones if there is less time.
QUANTILES = (1.0, 0.5, 0.75, 0.25, 0.9)
#: Tangents of a finer solve (measured: 0.6 to 1.5, and 3.2 on a bellows of one element through the wall), and of one of
#: the sweep; powers of the number of unknowns with which the time of a tangent and the memory of its factors grow
#: (measured on seals of 7 thousand to 110 thousand unknowns; nested dissection has 2 and 4/3 in the limit).
FINER_TANGENTS, SWEEP_TANGENTS, TIME_POWER, MEMORY_POWER = 2.5, 3.0, 1.5, 4.0 / 3.0
#: Time of a tangent of so many unknowns, on one core. It stands for every machine's, so that the number of states does
#: not depend on the machine.
SECONDS_OF_A_MILLION = 340.0
BYTES_OF_A_MILLION = 45e9
#: The same of an iterative solve: time in units of a tangent of the study's elements and of the ratio of unknowns
#: (measured on a seal of 287 thousand), memory of an unknown (6 kB on that seal, 12 kB on hexahedra of third order).
ITERATIVE_TANGENTS, ITERATIVE_BYTES = 6.0, 12e3
#: Contact's stiffness in the finer solutions over the study's.
STIFFER = 10.0
#: So many times along a path in time the clock is looked at.
PAUSES = 40
#: Highest order of a shell's displacements.
FINEST_SHELL = 3
#: Fields that follow from derivatives of the displacement, and part of the nodes that must have them for an estimate.
NODAL, FEWEST_REGULAR = {"strain", "stress_solid", "stress_top", "stress_bottom"}, 0.5
#: Of the last correction: at first in units of the body's size, then as a part of what the finer elements changed.
TOLERANCE, PART = 1e-2, 0.03


_LIMIT = f"a quarter of the build and {FLOOR:.0f} s"


class _NotEstimated(Exception):
    """Why there is no estimate."""


class OutOfTime(Exception):
    """A solve was stopped before it ended."""


def discretisation_errors(study: Study, snapshots: Snapshots, model: ReducedModel, seconds: float) -> dict[str, Any]:
    """The certificate's entry "discretisation", in plain JSON types.

    Parameters
    ----------
    study : with its defaults resolved.
    snapshots : its solutions.
    model : made from them.
    seconds : that the build has taken so far.

    Returns
    -------
    dict
        "method"; "unknowns" of the study's solid and of the finer one; "coordinates" of the states; "errors" of the
        held-out solutions against the finer ones by field, at the nodes of the model (`certificate.field_errors`);
        "singular_nodes", the most that a finer solution has no strain or stress at, which these errors leave out;
        "parameters", what they amount to in these (`parameter_errors`); "left_out", why some states are missing. Or
        only "not_estimated", the reason.
    """
    try:
        return _estimate(_refinable(study), snapshots, model, seconds)
    except _NotEstimated as reason:
        return {"not_estimated": str(reason)}


def _refinable(study: Study) -> SolidStudy | ShellStudy:
    """The study, if its solutions can be solved again with finer elements."""
    if isinstance(study, ExternalStudy):
        raise _NotEstimated("the solutions are another program's")
    if isinstance(study, SheetStudy):
        raise _NotEstimated("studies of sheets in grips have no finer elements to compare with")
    if not study.sampling.refined:
        raise _NotEstimated("switched off by sampling.refined = 0")
    if isinstance(study, ShellStudy):
        if study.solver.order >= FINEST_SHELL:
            raise _NotEstimated(f"shells of order {study.solver.order} have no finer elements to compare with")
        return study
    return study


def chosen_states(held_out: Sequence[Snapshot], count: int) -> list[int]:
    """Up to ``count`` held-out solutions: the one strained most, then typical ones, by the norm of nodal strains.

    Shells have stresses in place of strains.
    """
    strains = ("strain",) if "strain" in held_out[0].fields else ("stress_top", "stress_bottom")
    order = np.argsort([float(np.linalg.norm([snapshot.fields[name] for name in strains])) for snapshot in held_out])
    places = [round(quantile * (len(order) - 1)) for quantile in QUANTILES[:count]]
    return [int(order[place]) for place in dict.fromkeys(places)]


def _estimate(
    study: SolidStudy | ShellStudy, snapshots: Snapshots, model: ReducedModel, seconds: float
) -> dict[str, Any]:
    assert snapshots.problem is not None
    begin = time.monotonic()
    sweep = snapshots.problem()
    if isinstance(sweep, ViscousSweep):
        assert isinstance(study, SolidStudy)
        return _estimate_in_time(study, snapshots, model, sweep, seconds)
    assert isinstance(sweep, SolidSweep)
    solves = len(snapshots.training) + len(snapshots.held_out)
    finer = HigherOrder(sweep.problem, _finer(study, sweep.problem))
    chosen = chosen_states(snapshots.held_out, study.sampling.refined)
    chosen = chosen[: _affordable(_unknowns(sweep.problem, finer.problem), solves, finer.iterative)]
    kept = {index: load_state(snapshots.held_out_files[index]) for index in chosen}
    # Where solutions were found on disk, this build was shorter than the one that solved them.
    solving = SWEEP_TANGENTS * _tangent_seconds(sweep.problem, kept[chosen[0]]) * solves / (study.work.workers or 1)
    end = begin + CLOCK * max(SHARE / (1.0 - SHARE) * max(seconds, solving), FLOOR)
    announce(f"solving {len(chosen)} held-out states again with finer elements")

    def solve_again(index: int) -> Snapshot:
        state, pivots = kept[index], int(kept[index]["pivots"])
        found = finer.solve(state["dofs"], state["mu"], lambda: time.monotonic() < end)
        _check_same_branch(finer.problem, found, pivots)
        return _snapshot(finer.problem, found)

    solved, left_out = _solved_again(chosen, solve_again)
    figures = _figures(model, snapshots, sweep.problem, finer.problem, solved)
    return figures | left_out


def _solved_again(
    chosen: Sequence[int], solve_again: Callable[[int], Snapshot]
) -> tuple[dict[int, Snapshot], dict[str, str]]:
    """Finer solutions of the ``chosen`` held-out states, by index, and as "left_out" why some are missing, if any.

    Raises _NotEstimated where all are.
    """
    solved, left_out = dict[int, Snapshot](), ""
    for index in chosen:
        try:
            solved[index] = solve_again(index)
        except OutOfTime:
            left_out = f"{len(chosen) - len(solved)} of {len(chosen)} states would take more than {_LIMIT}"
            break
        except SolverError as error:
            left_out = f"one was left out: {error}"
    if not solved:
        raise _NotEstimated(left_out)
    return solved, {"left_out": left_out} if left_out else {}


def _estimate_in_time(
    study: SolidStudy, snapshots: Snapshots, model: ReducedModel, sweep: ViscousSweep, seconds: float
) -> dict[str, Any]:
    """The same of a viscous solid, whose states are followed from the beginning."""
    begin, finer = time.monotonic(), _finer(study, sweep.problem)
    unknowns = _unknowns(sweep.problem, finer)
    chosen = chosen_states(snapshots.held_out, study.sampling.refined)[: _affordable_paths(study, snapshots, unknowns)]
    end = begin + CLOCK * max(SHARE / (1.0 - SHARE) * seconds, FLOOR)
    announce(f"following {len(chosen)} held-out states again with finer elements and half the increments of time")
    halved = sweep.finer_in_time(finer)

    def follow_again(index: int) -> Snapshot:
        return _followed(halved, snapshots.held_out[index].coordinates, lambda: time.monotonic() < end)

    solved, left_out = _solved_again(chosen, follow_again)
    figures = _figures(model, snapshots, sweep.problem, finer, solved)
    figures["method"] += ", half the increments of time"
    return figures | left_out


def _followed(sweep: ViscousSweep, mu: Array, in_time: Callable[[], bool]) -> Snapshot:
    """The snapshot of a viscous solid at ``mu`` (d,); OutOfTime when ``in_time`` says no, asked along the path."""
    state = sweep.first_state()
    for moment in sweep.moments(mu, PAUSES):
        if not in_time():
            raise OutOfTime
        state = sweep.advance(state, moment)
    return sweep.take_snapshot(state)


def _affordable_paths(study: SolidStudy, snapshots: Snapshots, unknowns: list[int]) -> int:
    """How many paths in time, with finer elements and half the increments, a quarter of the build affords.

    Raises _NotEstimated where memory or time allow none.
    """
    assert study.time is not None
    own, finer = unknowns
    if _direct_bytes(finer) > MOST_BYTES:
        raise _NotEstimated(f"{finer} unknowns of finer elements would need about {1e-9 * _direct_bytes(finer):.0f} GB")
    clock = next(p for p in study.model_parameters() if p.name == study.time.parameter)
    solved = [group[0].coordinates for group in snapshots.training] + [s.coordinates for s in snapshots.held_out]
    others = np.delete(np.array(solved), list(study.parameters).index(clock.name), axis=1)
    paths = len(np.unique(others, axis=0))
    ratio = 2.0 * (finer / own) ** TIME_POWER
    increments = (clock.upper - clock.lower) / study.time.step
    of_one = ratio * SWEEP_TANGENTS * increments * SECONDS_OF_A_MILLION * (1e-6 * own) ** TIME_POWER
    count = int(max(SHARE / (1.0 - SHARE) * paths / ratio, FLOOR / of_one))
    if count < 1:
        raise _NotEstimated(
            f"one path with {finer} unknowns of finer elements would take as long as {ratio:.0f} of the build's "
            f"{paths} paths, more than {_LIMIT}"
        )
    return count


def _check_same_branch(problem: SolidProblem, found: State, pivots: int) -> None:
    """Raise SolverError if a finer solution is another equilibrium than the study's own, judged by its stability.

    The difference of two branches is no error of the elements. ``pivots`` are the negative eigenvalues of the study's
    tangent; -1 where they are unknown.
    """
    if pivots < 0 or found.negative_pivots in (None, pivots):
        return
    # The last tangent was made before the last correction.
    own = problem.linearise(found.dofs, found.mu).negative_pivots
    if own not in (None, pivots):
        raise SolverError(
            f"at {newton.where(problem, found.mu)} finer elements lead to an equilibrium of another stability ({own} "
            f"negative eigenvalues, the study's elements {pivots})"
        )


def _affordable(unknowns: list[int], solves: int, iterative: bool) -> int:
    """How many finer states a quarter of a build of ``solves``, or `FLOOR`, can afford.

    ``unknowns`` are those of `_unknowns`.

    Raises _NotEstimated where memory or time allow none.
    """
    own, finer = unknowns
    memory = ITERATIVE_BYTES * finer if iterative else _direct_bytes(finer)
    if memory > MOST_BYTES:
        raise _NotEstimated(f"{finer} unknowns of finer elements would need about {1e-9 * memory:.0f} GB of memory")
    tangents = ITERATIVE_TANGENTS * finer / own if iterative else FINER_TANGENTS * (finer / own) ** TIME_POWER
    time_of_one = tangents / SWEEP_TANGENTS
    seconds_of_one = tangents * SECONDS_OF_A_MILLION * (1e-6 * own) ** TIME_POWER
    count = int(max(SHARE / (1.0 - SHARE) * solves / time_of_one, FLOOR / seconds_of_one))
    if count < 1:
        raise _NotEstimated(
            f"one state with {finer} unknowns of finer elements would take as long as {time_of_one:.0f} of the build's "
            f"{solves} solves, more than {_LIMIT}"
        )
    return count


def _direct_bytes(unknowns: int) -> float:
    """Memory of a direct solve."""
    return BYTES_OF_A_MILLION * (1e-6 * unknowns) ** MEMORY_POWER


def _finer(study: SolidStudy | ShellStudy, coarse: SolidProblem) -> SolidProblem:
    """The study's solid or shell with displacements of one order more."""
    order = coarse.displacements.order + 1
    if isinstance(study, ShellStudy):
        return study.problem(ShellOptions(order=order, threads=coarse.options.threads))
    threads = coarse.options.threads
    options = SolidOptions(order=order, serendipity=True, at_nodes=True, contact=STIFFER, threads=threads)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearlyIncompressibleWarning)  # the study's elements were warned about
        return study.problem(options)


def _unknowns(coarse: SolidProblem, finer: SolidProblem) -> list[int]:
    """Displacement unknowns of both."""
    return [3 * problem.displacements.n_scalar for problem in (coarse, finer)]


def _tangent_seconds(problem: SolidProblem, state: dict[str, Array]) -> float:
    """Time of one tangent, its factors and a solve with them; the second one, for the first makes what is kept."""
    elapsed = []
    for _ in range(2):
        begin = time.monotonic()
        tangent = problem.linearise(state["dofs"], state["mu"])
        tangent.solve(tangent.residual)
        elapsed.append(time.monotonic() - begin)
    return min(elapsed)


class HigherOrder:
    """Solves the states of a solid again with displacements of higher order on the same cells.

    Parameters
    ----------
    coarse : the solid.
    problem : the same solid with elements of higher order.

    Attributes
    ----------
    iterative : whether its tangents are too large to be factorised, so that `TwoLevelSolver` has to do. That is for
        displacements alone: pressures that cells share make the tangent indefinite.
    """

    def __init__(self, coarse: SolidProblem, problem: SolidProblem) -> None:
        self._coarse, self.problem = coarse, problem
        n = 3 * problem.displacements.n_scalar
        self.iterative = _direct_bytes(n) > MOST_BYTES and not problem.assembly.coupled[n:].any()

    def solve(self, dofs: Array, mu: Array, in_time: Callable[[], bool] = lambda: True) -> State:
        """The solution at ``mu`` (d,) next to one of the coarse solid, to a few percent of the difference.

        First the unknowns that only the finer elements have are solved for, with the coarse solution ``dofs`` (n,)
        held: as finer displacements this one is strained far too much in bending, and Newton's method would take long
        from it. Where it does not converge, the forces that the start lacks for balance fade away in increments, so
        that the solution is on the same branch.

        Raises
        ------
        OutOfTime
            When ``in_time`` says no: it is asked before each factorisation.
        SolverError
            If no solution is found.
        """
        make = partial(TwoLevelSolver, lower=self._lower_order(dofs, mu)) if self.iterative else None
        equations, given = _Stoppable(self.problem, in_time, make), self._embedded(dofs)
        start = State(mu, given)
        try:
            start = solve(_Added(self.problem, in_time, self._kept, given, make), mu, start, TOLERANCE)
            # Where finer elements change nothing, a part of the change would be less than rounding.
            tolerance = max(PART * size(equations, start.dofs - given), newton.TOLERANCE)
            return solve(equations, mu, start, tolerance)
        except SolverError:
            if self.iterative:
                raise  # a path would take as long as many states
            return loaded_state(equations, mu, start.dofs, PART * TOLERANCE)

    @cached_property
    def _kept(self) -> NDArray[np.bool_]:
        """The dofs (n,) that the coarse solid has too."""
        return self._embedded(np.ones(self._coarse.n_dofs)) != 0.0

    def _lower_order(self, dofs: Array, mu: Array) -> LowerOrder:
        """The coarse solid's tangent at its solution ``dofs`` (n,)."""
        numbers = self._embedded(np.arange(1.0, self._coarse.n_dofs + 1.0))[: self.problem.n_unknowns]
        kept = np.flatnonzero(numbers)
        return LowerOrder(self._coarse.linearise(dofs, mu), numbers[kept].astype(np.int64) - 1, kept)

    def _embedded(self, dofs: Array) -> Array:
        """The displacement of a coarse solution, and the motions of its couplings, as dofs (n,) of the finer solid."""
        result = np.zeros(self.problem.n_dofs)
        coarse = dofs[: 3 * self._coarse.displacements.n_scalar]
        embedded = self.problem.displacements.embedded(self._coarse.displacements, coarse)
        result[: len(embedded)] = embedded
        result[self.problem.n_unknowns :] = dofs[self._coarse.n_unknowns :]
        return result


class _Stoppable:
    """The equations of a solid, whose factorisations stop when time is up."""

    def __init__(self, problem: SolidProblem, in_time: Callable[[], bool], make: SolverMaker | None) -> None:
        self._problem, self._in_time = problem, in_time
        self.n_dofs, self.free, self.scale = problem.n_dofs, problem.free, problem.scale
        self.in_contact, self.applied_first = problem.in_contact, problem.applied_first
        self.prescribed, self.prescribed_slopes = problem.prescribed, problem.prescribed_slopes
        self.residual, self.residual_slopes = problem.residual, problem.residual_slopes
        self._solver = problem.solver_of(problem.free, make) if make else problem.solver

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        if not self._in_time():
            raise OutOfTime
        return self._problem.linearise(x, mu, self._solver)


class _Added(_Stoppable):
    """The same with the ``kept`` (n,) dofs held as in ``given`` (n,)."""

    def __init__(
        self,
        problem: SolidProblem,
        in_time: Callable[[], bool],
        kept: NDArray[np.bool_],
        given: Array,
        make: SolverMaker | None,
    ) -> None:
        super().__init__(problem, in_time, make)
        self._kept, self._given = kept, given
        self.free, self.prescribed = problem.free & ~kept, self._held
        self._solver = problem.solver_of(self.free, make)

    def _held(self, mu: Array) -> Array:
        prescribed = self._problem.prescribed(mu)
        return np.where(self._kept & self._problem.free, self._given, prescribed)


def _snapshot(problem: SolidProblem, state: State) -> Snapshot:
    if isinstance(problem, ShellProblem):
        return shell_snapshot(problem, state.dofs, state.mu)
    return solid_snapshot(problem, state.dofs, state.mu)


def _figures(
    model: ReducedModel, snapshots: Snapshots, coarse: SolidProblem, finer: SolidProblem, solved: dict[int, Snapshot]
) -> dict[str, Any]:
    """Errors of the held-out solutions against the finer ones, field by field."""
    reactions = [name.removeprefix(REACTION) for name in model.fields if name.startswith(REACTION)]
    pairs = [
        (snapshots.held_out[index], with_reactions(finer_snapshot, reactions))
        for index, finer_snapshot in sorted(solved.items())
    ]
    shapes = [(own.coordinates, own.fields["displacement"], truth.fields["displacement"]) for own, truth in pairs]
    known = [_regular_nodes(truth) for _, truth in pairs]
    if min(mask.mean() for mask in known) < FEWEST_REGULAR:
        raise _NotEstimated(f"the finer solution has no stress at {max((~mask).sum() for mask in known)} nodes")

    def errors(name: str) -> dict[str, Any]:
        values = [(own.fields[name], truth.fields[name]) for own, truth in pairs]
        nodal = name in NODAL
        return field_errors(name, [(a[k], b[k]) if nodal else (a, b) for (a, b), k in zip(values, known, strict=True)])

    return {
        "method": f"displacements of order {finer.displacements.order} on the same cells",
        "unknowns": _unknowns(coarse, finer),
        "coordinates": [own.coordinates.tolist() for own, _ in pairs],
        "errors": {name: errors(name) for name in model.fields},
        "singular_nodes": max(int((~mask).sum()) for mask in known),
        ENTRY: parameter_errors(model, shapes),
    }


def _regular_nodes(solution: Snapshot) -> NDArray[np.bool_]:
    """Where (n,) strain and stress are numbers: laws have none where a cell is turned inside out, as at a sharp rim."""
    return np.all([np.isfinite(solution.fields[name]).all(axis=1) for name in NODAL & solution.fields.keys()], axis=0)
