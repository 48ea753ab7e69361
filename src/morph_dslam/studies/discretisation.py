"""The discretisation error of a study's solutions: a few held-out ones are solved again with elements of higher order.

One order more is finer than cells whose displacements are continuous. It is not finer than hexahedra with enhanced
strains: these bend, and keep their volume, by twelve unknowns that each cell has for itself, and continuous second-
order displacements of few cells are stiffer. They are compared with third order, which is not (against converged meshes
of bars and plates), where that can be afforded.

Viscous solids are followed again from the beginning, with half the increments of time besides.

States are chosen by their strain alone, before anything is solved. How many can be afforded, in a quarter of the
build's time or a minute, follows from numbers of unknowns, so that it is the same in every run; the clock ends what
takes longer than foreseen, and the certificate says what was left out and why. Time is the processor's, of the thread
that builds: on an idle computer it runs like a clock, however many threads help, and other programs do not count.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.loads import with_reactions
from morph_dslam.mechanics.shell_problem import ShellOptions, ShellProblem
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning
from morph_dslam.mechanics.solvers import newton
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.model import ReducedModel
from morph_dslam.model.parameter_errors import ENTRY, parameter_errors
from morph_dslam.model.reduced_model import REACTION
from morph_dslam.model.stated_errors import ESTIMABLE, NOT_ESTIMATED
from morph_dslam.reduction.certificate import field_errors, typical_sizes
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.higher_order import HigherOrder, OutOfTime
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
SHARE, FLOOR = 0.25, 60.0
#: States that are solved again where the study does not say how many.
REFINED = 3
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

_LIMIT = f"a quarter of the build and {FLOOR:.0f} s of processor time"
_ASK = "give sampling.refined to have it whatever the time"


class _NotEstimated(Exception):
    """Why there is no estimate.

    Attributes
    ----------
    estimable : whether there can be one of such a study.
    """

    def __init__(self, reason: str, estimable: bool = True) -> None:
        super().__init__(reason)
        self.estimable = estimable


def discretisation_errors(study: Study, snapshots: Snapshots, model: ReducedModel, seconds: float) -> dict[str, Any]:
    """The certificate's entry "discretisation", in plain JSON types.

    Parameters
    ----------
    study : with its defaults resolved.
    snapshots : its solutions.
    model : made from them.
    seconds : of processor time that the build has taken so far in this thread.

    Returns
    -------
    dict
        "method"; "unknowns" of the study's solid and of the finer one; "coordinates" of the states; "errors" of the
        held-out solutions against the finer ones by field, at the nodes of the model (`certificate.field_errors`);
        "singular_nodes", the most that a finer solution has no strain or stress at, which these errors leave out;
        "parameters", what they amount to in these (`parameter_errors`); "left_out", why some states are missing. Or
        "not_estimated", the reason, and "estimable", whether another run could state one.
    """
    try:
        return _estimate(_refinable(study), snapshots, model, seconds)
    except _NotEstimated as reason:
        return {NOT_ESTIMATED: str(reason), ESTIMABLE: reason.estimable}


def _refinable(study: Study) -> SolidStudy | ShellStudy:
    """The study, if its solutions can be solved again with finer elements."""
    if isinstance(study, ExternalStudy):
        raise _NotEstimated("the solutions are another program's", estimable=False)
    if isinstance(study, SheetStudy):
        raise _NotEstimated("studies of sheets in grips have no finer elements to compare with", estimable=False)
    if study.sampling.refined == 0:
        raise _NotEstimated("switched off by sampling.refined = 0")
    if isinstance(study, ShellStudy):
        if study.solver.order >= FINEST_SHELL:
            reason = f"shells of order {study.solver.order} have no finer elements to compare with"
            raise _NotEstimated(reason, estimable=False)
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
    sweep = snapshots.problem()
    if isinstance(sweep, ViscousSweep):
        assert isinstance(study, SolidStudy)
        return _estimate_in_time(study, snapshots, model, sweep, seconds)
    assert isinstance(sweep, SolidSweep)
    solves = len(snapshots.training) + len(snapshots.held_out)
    order = _order(study, sweep.problem, partial(_affordable, solves=solves, iterative=False))
    steps = _steps(study, sweep.problem, order)
    finer = steps[-1]
    unknowns = _unknowns(sweep.problem, finer.problem)
    _check_memory(unknowns[1], finer.iterative)
    chosen = _chosen(study, snapshots, partial(_affordable, unknowns, solves, finer.iterative))
    kept = {index: load_state(snapshots.held_out_files[index]) for index in chosen}
    solving = _solving_seconds(study, sweep.problem, kept[chosen[0]], solves)
    announce(f"solving {len(chosen)} held-out states again with finer elements")

    reached = dict[int, HigherOrder]()

    def solve_again(index: int, in_time: Callable[[], bool]) -> Snapshot:
        step, found = _highest(steps, kept[index], in_time)
        snapshot, reached[index] = _snapshot(step.problem, found), step
        return replace(snapshot, outputs=snapshot.outputs | step.reactions_in_balance(found))

    solved, left_out = _solved_again(chosen, solve_again, _budget(study, max(seconds, solving)))
    orders = [reached[index].problem.displacements.order for index in solved]
    finest = next(step.problem for step in steps if step.problem.displacements.order == max(orders))
    figures = _figures(model, snapshots, sweep.problem, finest, solved)
    if lower := [order for order in orders if order < max(orders)]:
        figures["method"] += (
            f", of order {lower[0]} in {len(lower)} of {len(orders)} states, where these do not converge in time on "
            "the same branch"
        )
    return figures | left_out


def _highest(
    steps: Sequence[HigherOrder], state: dict[str, Array], in_time: Callable[[], bool]
) -> tuple[HigherOrder, State]:
    """The last of the ``steps`` from one of the study's states that converges on its branch, and what it finds.

    Raises OutOfTime or SolverError where none does.
    """
    found: list[State] = []
    for step in steps:
        try:
            next_one = step.solve(found[-1].dofs if found else state["dofs"], state["mu"], in_time)
            _check_same_branch(step.problem, next_one, int(state["pivots"]))
        except (OutOfTime, SolverError):
            if not found:
                raise
            break  # of the states that strain a body most, more must not be left out than need be
        found.append(next_one)
    return steps[len(found) - 1], found[-1]


def _chosen(study: SolidStudy | ShellStudy, snapshots: Snapshots, affordable: Callable[[], int]) -> list[int]:
    """The held-out states to solve again: as many as the study asks for, or by itself as many as are ``affordable``."""
    if study.sampling.refined is not None:
        return chosen_states(snapshots.held_out, study.sampling.refined)
    return chosen_states(snapshots.held_out, REFINED)[: affordable()]


def _budget(study: SolidStudy | ShellStudy, building: float) -> float:
    """Seconds that the finer solves of a study may take, the build of which has taken ``building``."""
    if study.sampling.refined is not None:
        return np.inf
    return CLOCK * max(SHARE / (1.0 - SHARE) * building, FLOOR)


def _solving_seconds(
    study: SolidStudy | ShellStudy, problem: SolidProblem, state: dict[str, Array], solves: float
) -> float:
    """Time of a build of so many ``solves``, at least.

    Where solutions were found on disk, or solved in other processes, this thread has spent less.
    """
    return SWEEP_TANGENTS * _tangent_seconds(problem, state) * solves / (study.work.workers or 1)


def _solved_again(
    chosen: Sequence[int], solve_again: Callable[[int, Callable[[], bool]], Snapshot], seconds: float
) -> tuple[dict[int, Snapshot], dict[str, str]]:
    """Finer solutions of the ``chosen`` held-out states, by index, and as "left_out" why some are missing, if any.

    Each may take its share of what is left of the ``seconds``: one that does not converge leaves the others theirs.

    Raises _NotEstimated where all are missing.
    """
    solved, late, failed = dict[int, Snapshot](), 0, list[str]()
    begin = time.thread_time()
    for number, index in enumerate(chosen):
        now = time.thread_time()
        share = (begin + seconds - now) / (len(chosen) - number)
        try:
            solved[index] = solve_again(index, partial(_before, now + share))
        except OutOfTime:
            late += 1
        except SolverError as error:
            failed.append(str(error))
    # The first reason stands for all: every run with the model repeats it.
    missing = f"{len(failed)} of {len(chosen)} states were left out: {failed[0]}" if failed else ""
    slow = f"{late} of {len(chosen)} states would take more than {_LIMIT}: {_ASK}" if late else ""
    left_out = "; ".join(filter(None, (missing, slow)))
    if not solved:
        raise _NotEstimated(left_out)
    return solved, {"left_out": left_out} if left_out else {}


def _before(end: float) -> bool:
    return time.thread_time() < end


def _estimate_in_time(
    study: SolidStudy, snapshots: Snapshots, model: ReducedModel, sweep: ViscousSweep, seconds: float
) -> dict[str, Any]:
    """The same of a viscous solid, whose states are followed from the beginning."""
    count, increments = paths = _paths(study, snapshots)
    order = _order(study, sweep.problem, partial(_affordable_paths, paths=count, increments=increments))
    finer = _finer(study, sweep.problem, order)
    unknowns = _unknowns(sweep.problem, finer)
    _check_memory(unknowns[1], iterative=False)
    chosen = _chosen(study, snapshots, partial(_affordable_paths, unknowns, *paths))
    state = load_state(snapshots.held_out_files[chosen[0]])
    assert sweep.problem.history is not None
    sweep.problem.history.restore(state["memory"])
    solving = _solving_seconds(study, sweep.problem, state, paths[0] * paths[1])
    announce(f"following {len(chosen)} held-out states again with finer elements and half the increments of time")
    halved = sweep.finer_in_time(finer)

    def follow_again(index: int, in_time: Callable[[], bool]) -> Snapshot:
        return _followed(halved, snapshots.held_out[index].coordinates, in_time)

    solved, left_out = _solved_again(chosen, follow_again, _budget(study, max(seconds, solving)))
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


def _paths(study: SolidStudy, snapshots: Snapshots) -> tuple[int, float]:
    """Number of the paths in time of a build, and of increments of each."""
    assert study.time is not None
    clock = next(p for p in study.model_parameters() if p.name == study.time.parameter)
    solved = [group[0].coordinates for group in snapshots.training] + [s.coordinates for s in snapshots.held_out]
    others = np.delete(np.array(solved), list(study.parameters).index(clock.name), axis=1)
    return len(np.unique(others, axis=0)), (clock.upper - clock.lower) / study.time.step


def _affordable_paths(unknowns: list[int], paths: int, increments: float) -> int:
    """How many paths in time, with finer elements and half the increments, a quarter of the build affords.

    Raises _NotEstimated where it affords none.
    """
    ratio = 2.0 * (unknowns[1] / unknowns[0]) ** TIME_POWER
    return _afforded(unknowns, paths, ratio, ratio * SWEEP_TANGENTS * increments, ("path", "paths"))


def _afforded(unknowns: list[int], count: int, ratio: float, tangents: float, names: tuple[str, str]) -> int:
    """How many finer solutions a quarter of a build of ``count``, or `FLOOR`, affords.

    Each takes as long as ``ratio`` of the build's and as so many ``tangents``; ``names`` are those of one and of many.
    Raises _NotEstimated where none is afforded.
    """
    own, finer = unknowns
    seconds_of_one = tangents * SECONDS_OF_A_MILLION * (1e-6 * own) ** TIME_POWER
    afforded = int(max(SHARE / (1.0 - SHARE) * count / ratio, FLOOR / seconds_of_one))
    if afforded < 1:
        raise _NotEstimated(
            f"one {names[0]} with {finer} unknowns of finer elements would take as long as {ratio:.0f} of the build's "
            f"{count} {names[1]}, more than {_LIMIT}: {_ASK}"
        )
    return afforded


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


def _check_memory(unknowns: int, iterative: bool) -> None:
    """Raise _NotEstimated where a finer solve of so many ``unknowns`` needs too much memory."""
    memory = ITERATIVE_BYTES * unknowns if iterative else _direct_bytes(unknowns)
    if memory > MOST_BYTES:
        raise _NotEstimated(f"{unknowns} unknowns of finer elements would need about {1e-9 * memory:.0f} GB of memory")


def _affordable(unknowns: list[int], solves: int, iterative: bool) -> int:
    """How many finer states a quarter of a build of ``solves``, or `FLOOR`, can afford.

    ``unknowns`` are those of `_unknowns`.

    Raises _NotEstimated where it affords none.
    """
    own, finer = unknowns
    tangents = ITERATIVE_TANGENTS * finer / own if iterative else FINER_TANGENTS * (finer / own) ** TIME_POWER
    return _afforded(unknowns, solves, tangents / SWEEP_TANGENTS, tangents, ("state", "solves"))


def _is_too_large(problem: SolidProblem) -> bool:
    """Whether tangents are too large to be factorised, and an iterative solver can take them.

    That is for displacements alone: pressures that cells share make the tangent indefinite.
    """
    n = 3 * problem.displacements.n_scalar
    return _direct_bytes(n) > MOST_BYTES and not problem.assembly.coupled[n:].any()


def _direct_bytes(unknowns: int) -> float:
    """Memory of a direct solve."""
    return BYTES_OF_A_MILLION * (1e-6 * unknowns) ** MEMORY_POWER


def _order(study: SolidStudy | ShellStudy, coarse: SolidProblem, affordable: Callable[[list[int]], int]) -> int:
    """Of displacements that are finer than the study's.

    Parameters
    ----------
    affordable : number of states, of unknowns as `_unknowns` has them; raises _NotEstimated where it is none.
    """
    order = coarse.displacements.order + 1
    if coarse.enhanced is None:
        return order
    full = 3 * ngs.H1(coarse.geometry.ngs, order=order + 1).ndof
    if _direct_bytes(full) > MOST_BYTES:
        return order
    if study.sampling.refined is None:
        try:
            affordable([3 * coarse.displacements.n_scalar, full])
        except _NotEstimated:
            return order
    return order + 1


def _steps(study: SolidStudy | ShellStudy, coarse: SolidProblem, order: int) -> list[HigherOrder]:
    """From the study's elements to those of an order, one order at a time.

    Each begins from the solution of the one before: from hexahedra with enhanced strains straight to third order, a
    bellows takes 31 tangents, and 3 from second order, whose own cost little.
    """
    finer = (_finer(study, coarse, each) for each in range(coarse.displacements.order + 1, order + 1))
    return [HigherOrder(one, other, _is_too_large(other)) for one, other in pairwise((coarse, *finer))]


def _finer(study: SolidStudy | ShellStudy, coarse: SolidProblem, order: int) -> SolidProblem:
    """The study's solid or shell with displacements of a higher order."""
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
        begin = time.thread_time()
        tangent = problem.linearise(state["dofs"], state["mu"])
        tangent.solve(tangent.residual)
        elapsed.append(time.thread_time() - begin)
    return min(elapsed)


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
    known, sizes = [_regular_nodes(truth) for _, truth in pairs], typical_sizes(model, snapshots.coordinates)
    if min(mask.mean() for mask in known) < FEWEST_REGULAR:
        raise _NotEstimated(f"the finer solution has no stress at {max((~mask).sum() for mask in known)} nodes")

    def errors(name: str) -> dict[str, Any]:
        values = [(own.fields[name], truth.fields[name]) for own, truth in pairs]
        if name in NODAL:
            values = [(a[k], b[k]) for (a, b), k in zip(values, known, strict=True)]
        return field_errors(name, values, sizes[name])

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
