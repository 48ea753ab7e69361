"""The paper's sheet with its clamped ends brought together: buckling load, path beyond it, positions along it.

The path is followed by arc length from the first buckling mode as a small imperfection. Positions equally spaced along
it are then solved between the path's points, many from one factorisation, in parallel if asked for. What was solved is
kept in a folder and not solved again.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend.mechanics import State, sensitivities
from morph_dslam.extend.sheets import (
    ArcLength,
    ArcOptions,
    KoiterSheet,
    OrthotropicSheet,
    PathPoint,
    SheetEquations,
    buckling_modes,
    output_points,
    rectangle_mesh,
)
from morph_dslam.extend.studies import SOLVER_VERSION, Snapshot, save_snapshot

Array = NDArray[np.float64]

#: The end force needs the ends' distance far more precisely than the shape: the sheet is stiff along itself.
PATH_OPTIONS = ArcOptions(first=2e-7, smallest=1e-10, largest=0.005, corrections=10, contraction=0.5, tolerance=1e-11)


@dataclass(frozen=True)
class BuckledSheet:
    """The problem.

    Attributes
    ----------
    length, width : m; the ends at x = -length/2 and x = length/2 are clamped and approach each other.
    cells : elements along x and y; results are given at their corners.
    order : polynomial degree of the displacements.
    imperfection : height of the stress-free sheet's middle above the plane, in the first mode's shape, m.
    """

    length: float
    width: float
    material: OrthotropicSheet
    cells: tuple[int, int]
    order: int = 2
    imperfection: float = 2e-6

    def __getstate__(self) -> dict[str, Any]:
        """What is sent to worker processes: the description without the shell that was built from it."""
        return {name: value for name, value in vars(self).items() if name != "shell"}

    @cached_property
    def shell(self) -> KoiterSheet:
        half, side = self.length / 2.0, self.width / 2.0
        x, y = (np.linspace(-a, a, n + 1) for a, n in zip((half, side), self.cells, strict=True))
        return KoiterSheet(rectangle_mesh(x, y), self.material, self.order, clamped="left|right")

    def equations(self, condensed: bool, threads: int | None = None) -> SheetEquations:
        """Equilibrium with mu[0] the approach of the ends, m."""
        inwards = {"left": np.array([0.5, 0.0, 0.0]), "right": np.array([-0.5, 0.0, 0.0])}
        return SheetEquations(self.shell, inwards, self.length, condensed, threads)

    @property
    def points(self) -> Array:
        """Material points (n, 2) of the results: the corners of the elements, x fastest, m."""
        return output_points(self.length, self.width, self.cells)

    def height(self, dofs: Array) -> float:
        """Height of the sheet's middle above the plane, m."""
        field = ngs.GridFunction(self.shell.scalar_space)
        field.vec.FV().NumPy()[:] = dofs[self.shell.displacement_dofs(2)]
        return float(field(self.shell.mesh(0.0, 0.0)))

    def first_buckling(self) -> tuple[float, Array]:
        """Eigenvalue as the end force, N, and the mode (n_dofs,), its middle 1 m up."""
        equations = self.equations(condensed=False)
        flat = State(np.zeros(2), np.zeros(equations.n_dofs))
        euler_strain = np.pi**2 / 3.0 * (self.material.thickness / self.length) ** 2
        mode = buckling_modes(equations, flat, 0, step=0.1 * euler_strain * self.length)[0]
        # The flat sheet's response is linear: any part of the critical approach tells its force.
        part = 1e-3
        dofs = part * mode.change * sensitivities(equations, flat)[0]
        force = equations.end_force(dofs, np.array([part * mode.change, 0.0])) / part
        return force, mode.shape / self.height(mode.shape)


@dataclass(frozen=True)
class PathRecord:
    """A point of the path with the height of the sheet's middle, m, and the end force, N."""

    point: PathPoint
    height: float
    end_force: float


@dataclass(frozen=True)
class BucklingFolder:
    """What is kept of one run: the eigenvalue, the path's points, and the positions.

    Attributes
    ----------
    root : see `of`.
    count : number of positions.
    """

    root: Path
    count: int

    @staticmethod
    def of(output: Path, sheet: BuckledSheet, height: float, count: int) -> BucklingFolder:
        """The folder in ``output`` for one sheet, final height and solver version."""
        recipe = f"{sheet} {height} {SOLVER_VERSION}"
        return BucklingFolder(output / hashlib.sha256(recipe.encode()).hexdigest()[:16], count)

    def buckling(self, sheet: BuckledSheet) -> tuple[float, Array]:
        """`BuckledSheet.first_buckling`, worked out once."""
        file = self.root / "buckling.npz"
        if not file.is_file():
            self.root.mkdir(parents=True, exist_ok=True)
            force, mode = sheet.first_buckling()
            _write(file, force=force, mode=mode)
        with np.load(file) as kept:
            return float(kept["force"]), kept["mode"]

    def path_file(self, number: int) -> Path:
        return self.root / "path" / f"{number:04d}.npz"

    def position_file(self, number: int) -> Path:
        return self.root / f"positions-{self.count}" / f"{number:04d}.npz"

    def save_point(self, number: int, record: PathRecord) -> None:
        point, file = record.point, self.path_file(number)
        file.parent.mkdir(parents=True, exist_ok=True)
        pivots = -1 if point.state.negative_pivots is None else point.state.negative_pivots
        scalars = [point.length, point.rate, point.step, point.corrections, pivots]
        results = [record.height, record.end_force]
        _write(
            file, mu=point.state.mu, dofs=point.state.dofs, tangent=point.tangent, scalars=np.array(scalars + results)
        )

    def load_point(self, number: int) -> PathRecord:
        with np.load(self.path_file(number)) as kept:
            length, rate, step, corrections, pivots, *results = kept["scalars"].tolist()
            state = State(kept["mu"], kept["dofs"], None if pivots < 0 else int(pivots), 1)
            return PathRecord(PathPoint(state, length, kept["tangent"], rate, step, int(corrections)), *results)

    def points(self) -> list[PathRecord]:
        """All points that are kept, in order."""
        files = sorted((self.root / "path").glob("[0-9]*.npz"))
        return [self.load_point(number) for number in range(len(files))]


def _write(file: Path, **arrays: Array | float) -> None:
    """Write an archive that appears only when it is complete."""
    partial = file.with_suffix(f".{os.getpid()}.partial")
    with partial.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    os.replace(partial, file)


def _arc(sheet: BuckledSheet, folder: BucklingFolder, threads: int | None) -> tuple[ArcLength, State]:
    """The imperfect sheet's arc length solver, and its unloaded state."""
    equations = sheet.equations(condensed=True, threads=threads)
    _, mode = folder.buckling(sheet)
    equations.set_imperfection(sheet.imperfection * mode)
    return ArcLength(equations, options=PATH_OPTIONS), State(np.zeros(2), equations.unloaded)


def follow_path(sheet: BuckledSheet, folder: BucklingFolder, height: float) -> Iterator[PathRecord]:
    """Points from the unloaded sheet until its middle is ``height`` m up; those that are kept come first.

    Raises
    ------
    SolverError
        If the path cannot be followed so far: the height may be more than the sheet can reach.
    """
    kept = folder.points()
    yield from kept
    if kept and kept[-1].height >= (1.0 - 1e-7) * height:
        return
    arc, unloaded = _arc(sheet, folder, threads=None)
    start = kept[-1].point if kept else unloaded
    highest = kept[-1].height if kept else -np.inf
    with ngs.TaskManager():
        path = arc.follow(start, lambda state: sheet.height(state.dofs) - height)
        for number, point in enumerate(path, start=max(0, len(kept) - 1)):
            if number < len(kept):
                continue  # the point gone on from
            state = point.state
            force = arc.equations.end_force(state.dofs, state.mu)  # type: ignore[attr-defined]
            record = PathRecord(point, sheet.height(state.dofs), force)
            if record.height < highest:
                raise md.MorphError(
                    f"the sheet's middle rises to {1e3 * highest:.2f} mm and falls again where its ends have "
                    f"approached by {1e3 * state.mu[0]:.0f} mm: ask for less than {1e3 * height:.2f} mm"
                )
            highest = record.height
            folder.save_point(number, record)
            yield record


@lru_cache(maxsize=1)
def _worker(sheet: BuckledSheet, folder: BucklingFolder) -> ArcLength:
    """A worker process' solver, built once; one thread, since the workers fill the cores."""
    ngs.SetNumThreads(1)
    return _arc(sheet, folder, threads=1)[0]


def solve_positions(
    sheet: BuckledSheet, folder: BucklingFolder, number: int, positions: dict[int, float], end: float
) -> None:
    """Solve positions that lie between two points of the path and keep each as a snapshot.

    Parameters
    ----------
    number : of the path's point before them.
    positions : their numbers, and lengths along the path.
    end : length of the whole path: a snapshot's coordinate is the part of it.
    """
    arc, point = _worker(sheet, folder), folder.load_point(number).point
    following = folder.load_point(number + 1).point if folder.path_file(number + 1).is_file() else None
    for position, length in positions.items():
        file = folder.position_file(position)
        if file.is_file():
            continue
        on_point = length == point.length
        state = point.state if on_point else arc.locate(point, length - point.length, following)
        file.parent.mkdir(parents=True, exist_ok=True)
        save_snapshot(file, take_snapshot(sheet, arc.equations, state, length / end), {})  # type: ignore[arg-type]


def take_snapshot(sheet: BuckledSheet, equations: SheetEquations, state: State, position: float) -> Snapshot:
    """Displacement and both faces' stresses at the mesh's corners, and the sheet's heights and forces."""
    displacement, faces = sheet.shell.sample(state.dofs, sheet.points)
    return Snapshot(
        np.array([position]),
        {"displacement": displacement, "stress_top": faces["top"], "stress_bottom": faces["bottom"]},
        outputs={
            "approach": state.mu[0],
            "height": np.array(sheet.height(state.dofs)),
            "bending_energy": np.array(equations.bending_energy(state.dofs, state.mu)),
            "end_force": np.array(equations.end_force(state.dofs, state.mu)),
        },
    )


def positions_by_point(points: list[PathPoint], count: int) -> list[tuple[int, dict[int, float]]]:
    """Positions equally spaced along the path, each under the last of the points that is not beyond it."""
    lengths = np.array([point.length for point in points])
    wanted = np.linspace(0.0, lengths[-1], count)
    before = np.searchsorted(lengths, wanted, side="right") - 1
    return [
        (int(number), {int(i): float(wanted[i]) for i in np.flatnonzero(before == number)})
        for number in np.unique(before)
    ]


def southwell_load(heights: Array, forces: Array, imperfection: float, largest: float) -> float:
    """Buckling load from the beginning of an imperfect sheet's path, N.

    Deflection over force against deflection is a straight line of slope 1 / P_cr (Southwell, Proc. R. Soc. A
    135, 1932), as long as the deflection is small against the thickness and large against the imperfection.

    Parameters
    ----------
    heights, forces : (n,) of the middle, the imperfection included, m; end forces, N.
    largest : deflection that still counts as small, m.

    Raises
    ------
    ValueError
        If fewer than four points lie where the line is straight.
    """
    deflection = heights - imperfection
    straight = (deflection > 3.0 * imperfection) & (deflection < largest)
    if np.count_nonzero(straight) < 4:
        raise ValueError("fewer than four points lie on the straight part of Southwell's plot")
    slope, _ = np.polyfit(deflection[straight], deflection[straight] / forces[straight], 1)
    return float(1.0 / slope)
