"""A bellows turned by 52 degrees in steps of 4, against felupe on the same mesh, law and linear solver.

Half a corrugated tube, 18 900 linear hexahedra, 77 592 dofs, the paper's neo-Hookean law; the moment at the
end, measured with two other codes, is 471.40752914 N mm, the largest displacement 49.10450154 mm.
The default elements, hexahedra with enhanced strains, are followed too: their time over that of the same linear ones.
Both sides take the same steps. Ours predicts each by extrapolation of the solutions before, felupe's iteration by the
tangent at the last one; the numbers of factorisations, which are printed, show what that makes. Ours ends when the last
correction is below 1e-8 of the body's length, felupe's when the residual is below 1e-8 of the reactions.
felupe is GPL, so it is never installed with the project: the first run makes an environment of its own for it
in .venv-bench (some hundred megabytes). Both sides run in that environment, one after the other.
Run: python benchmarks/boot_seal.py
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from peer_environment import peer_python

ROOT = Path(__file__).resolve().parents[1]
PEER = ROOT / "benchmarks" / "peers" / "felupe_path.py"
YOUNG, POISSON = 3e6, 0.45
#: Where the axis of the turning top passes, m.
PIVOT = np.array([0.0, 0.0, 0.045])
ANGLES = np.radians(np.arange(4.0, 52.1, 4.0))
#: The free residual over the reactions at which the peer's Newton iteration ends.
TOLERANCE = 1e-8


def bellows() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Nodes in metres, hexahedra, and the node sets bottom, top and symmetry (y = 0) of half a bellows."""
    through, around, along = 3, 60, 105
    height, radius, depth, folds, wall = 90.0, 30.0, 4.0, 4, 3.0
    z, phi = np.linspace(0.0, height, along + 1), np.linspace(0.0, np.pi, around + 1)
    wave = 2.0 * np.pi * folds / height
    slope = -depth * wave * np.sin(wave * z)
    normal = np.column_stack([np.ones_like(z), -slope]) / np.sqrt(1.0 + slope**2)[:, None]
    normal[[0, -1]] = 1.0, 0.0
    offset = wall * np.linspace(-0.5, 0.5, through + 1)
    r = (radius + depth * np.cos(wave * z))[:, None] + normal[:, :1] * offset
    heights = z[:, None] + normal[:, 1:] * offset
    points = np.empty((along + 1, around + 1, through + 1, 3))
    points[..., 0] = r[:, None] * np.cos(phi)[:, None]
    points[..., 1] = r[:, None] * np.sin(phi)[:, None]
    points[..., 2] = heights[:, None]
    points[:, [0, -1], :, 1] = 0.0
    index = np.arange(points.size // 3).reshape(points.shape[:3])

    def corner(i: int, j: int, k: int) -> np.ndarray:
        return index[k : along + k, j : around + j, i : through + i].ravel()

    ring = ((0, 0), (1, 0), (1, 1), (0, 1))
    hexes = np.stack([corner(i, j, k) for k in (0, 1) for i, j in ring], axis=1)
    sets = {"bottom": index[0].ravel(), "top": index[-1].ravel(), "symmetry": index[:, [0, -1]].ravel()}
    return 1e-3 * points.reshape(-1, 3), hexes, sets


def follow_path(formulation: str) -> dict:
    """Solve the path with this project, by "displacement" or "automatic" elements."""
    from morph_dslam import Parameter, SolidProblem
    from morph_dslam.extend.mechanics import (
        CellBlock,
        Mesh,
        NeoHookean,
        ParameterSymbols,
        PrescribedDisplacement,
        RigidRotation,
        SolidOptions,
        State,
        advance,
        fixed,
    )

    nodes, hexes, sets = bellows()
    symbols = ParameterSymbols((Parameter("lever", "angle", "deg", 0.0, float(ANGLES[-1]), 0.0),))
    turned = RigidRotation("top", axis=(0.0, 1.0, 0.0), angle=symbols["lever"], centre=tuple(PIVOT))
    supports = [fixed("bottom"), turned, PrescribedDisplacement("symmetry", y=0.0)]
    mesh = Mesh(nodes, (CellBlock("hex8", hexes),), node_sets=sets)
    rubber = NeoHookean(young=YOUNG, poisson=POISSON)
    options = SolidOptions(mixed=False if formulation == "displacement" else None)
    problem = SolidProblem(mesh, {"all": rubber}, supports, parameters=symbols, options=options)
    undeformed = State(np.zeros(1), np.zeros(problem.n_dofs))
    start, processor = time.perf_counter(), time.process_time()
    states = advance(problem, undeformed, ANGLES[:, None])
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    end = states[-1]
    _, moment = problem.reactions(end.dofs, end.mu, "top", PIVOT)
    return {
        "dofs": problem.n_dofs,
        "seconds": seconds,
        "processor_seconds": processor,
        "iterations": [state.iterations for state in states[1:]],
        "moment": float(moment[1]),
        "largest": float(np.abs(problem.nodal_displacement(end.dofs)).max()),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }


def run_peer(python: Path, folder: Path) -> dict:
    """Solve the path with felupe, in a process of its own."""
    nodes, hexes, sets = bellows()
    problem, result = folder / "problem.npz", folder / "felupe.json"
    constants = {
        "shear_modulus": YOUNG / (2.0 * (1.0 + POISSON)),
        "lame_lambda": YOUNG * POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON)),
        "tolerance": TOLERANCE,
    }
    np.savez(problem, nodes=nodes, hexes=hexes, pivot=PIVOT, angles=ANGLES, **sets, **constants)
    subprocess.run([python, PEER, problem, result], check=True)
    return json.loads(result.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ours", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.ours:
        formulation, target = arguments.ours
        Path(target).write_text(json.dumps(follow_path(formulation)))
        return
    python = peer_python("felupe", "felupe>=11")
    with tempfile.TemporaryDirectory() as folder:
        rows = {}
        for name, formulation in (("morph-dslam", "displacement"), ("enhanced", "automatic")):
            ours = Path(folder) / "ours.json"
            subprocess.run([python, __file__, "--ours", formulation, ours], check=True)
            rows[name] = json.loads(ours.read_text())
        rows["felupe"] = run_peer(python, Path(folder))
    for name, row in rows.items():
        print(
            f"{name:12s} {row['seconds']:7.1f} s  processor {row['processor_seconds']:7.1f} s  "
            f"{sum(row['iterations'])} factorisations  "
            f"moment {1e3 * row['moment']:.8f} N mm  largest {1e3 * row['largest']:.8f} mm  "
            f"peak {row['peak_memory_mb']:.0f} MB"
        )
    a, b, enhanced = rows["morph-dslam"], rows["felupe"], rows["enhanced"]
    print(
        f"dofs={a['dofs']} time_ratio={a['seconds'] / b['seconds']:.3f} "
        f"processor_ratio={a['processor_seconds'] / b['processor_seconds']:.3f} "
        f"moment_difference={abs(a['moment'] / b['moment'] - 1.0):.1e} "
        f"enhanced_time_ratio={enhanced['seconds'] / a['seconds']:.3f} "
        f"enhanced_processor_ratio={enhanced['processor_seconds'] / a['processor_seconds']:.3f} "
        f"peak_memory_MB={a['peak_memory_mb']:.0f}"
    )


if __name__ == "__main__":
    main()
