"""The discretisation error that a certificate states, against that of elements one order higher still.

A bellows of 2 457 nodes, linear hexahedra, turned by up to 52 degrees. The build solves held-out states again with
second order; here the same states are solved with third order. The effectivity of an error is what the certificate
states over what third order says: 1 is perfect.
Four builds of 28 to 30 solves follow: their estimates, whose finer solves end early, against the same finer elements
solved from the defaults to the end.
Run: python benchmarks/discretisation.py
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import morph_dslam as md
from morph_dslam.extend.mechanics import SolidOptions, State, advance, loaded_state, solve

HEIGHT, RADIUS, DEPTH, FOLDS = 90.0, 30.0, 4.0, 4
DIVISIONS = (38, 2, 21)


def bellows(divisions: tuple[int, int, int], pull: str, sampling: dict[str, Any]) -> Any:
    """The study; the wall is 3 mm thick. The top moves up by ``pull``, an expression of the lever's angle."""
    z = np.linspace(0.0, HEIGHT, divisions[0] + 1)
    profile = np.column_stack([RADIUS + DEPTH * np.cos(2.0 * np.pi * FOLDS * z / HEIGHT), z])
    turned = {
        "kind": "rotation",
        "on": "top",
        "axis": [0, 1, 0],
        "centre": ["0 mm", "0 mm", "45 mm"],
        "angle": "lever",
        "translation": ["0 mm", "0 mm", pull],
    }
    return md.make_study(
        {
            "name": "bellows",
            "mesh": {
                "generator": "revolution",
                "profile": profile.tolist(),
                "unit": "mm",
                "thickness": "3 mm",
                "divisions": list(divisions),
                "cells": "hex8",
            },
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.45}},
            "supports": [{"kind": "fixed", "on": "bottom"}, turned],
            "parameters": {"lever": {"range": ["0 deg", "52 deg"]}},
            "sampling": sampling,
            "solver": {"workers": 1, "threads": 1},
        }
    )


def block(divisions: list[int], cells: str, poisson: float) -> Any:
    """A bar of rubber, pushed sideways and pulled, or pressed, at its end."""
    return md.make_study(
        {
            "name": "bar",
            "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "80 mm"], "divisions": divisions, "cells": cells},
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": poisson}},
            "supports": [{"kind": "fixed", "on": "z_min"}],
            "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "pull"]}],
            "parameters": {"push": {"range": ["0 kPa", "10 kPa"]}, "pull": {"range": ["-20 kPa", "100 kPa"]}},
            "sampling": {"scheme": "sobol", "training": 24, "held_out": 6},
            "reduction": {"method": "pod"},
            "solver": {"workers": 1, "threads": 1},
        }
    )


def short_builds() -> None:
    """Print the effectivity of the estimates of short builds."""
    studies = {
        "bar, hex8": block([4, 4, 16], "hex8", 0.45),
        "nearly incompressible bar, hex8": block([4, 4, 16], "hex8", 0.4999),
        "bar, tet10": block([3, 3, 12], "tet10", 0.45),
        "bellows, hex8": bellows((20, 1, 12), "0 mm", {"scheme": "sobol", "training": 20, "held_out": 8}),
    }
    for name, study in studies.items():
        with tempfile.TemporaryDirectory() as folder:
            stated = md.build(study, Path(folder) / "small.morph").certificate["discretisation"]
        own = study.problem(None)
        options = SolidOptions(order=own.displacements.order + 1, serendipity=True, at_nodes=True)
        finer, pairs = study.problem(options), []
        for coordinates in stated["coordinates"]:
            ends = [loaded_state(problem, np.array(coordinates)) for problem in (own, finer)]
            pairs.append([p.sample(end.dofs, end.mu) for p, end in zip((own, finer), ends, strict=True)])
        said = stated["errors"]
        mean = 1e3 * np.mean([np.linalg.norm(a["displacement"] - b["displacement"], axis=1) for a, b in pairs])
        ours, true = (
            np.array(values) for values in zip(*((a["von_mises"], b["von_mises"]) for a, b in pairs), strict=True)
        )
        missed = np.linalg.norm(ours - true) / np.linalg.norm(true)
        print(
            f"{name}: states={len(pairs)} "
            f"displacement={said['displacement']['mean_mm'] / mean:.3f} "
            f"von_mises={said['stress_solid']['von_mises']['relative_l2'] / missed:.3f}"
        )


def main() -> None:
    study = bellows(DIVISIONS, "0 mm", {"scheme": "sobol", "training": 128, "held_out": 40, "refined": 3})
    with tempfile.TemporaryDirectory() as folder:
        stated = md.build(study, Path(folder) / "bellows.morph").certificate["discretisation"]
    own, second, third = (study.problem(options) for options in (None, SolidOptions(order=2), SolidOptions(order=3)))
    states, pairs = [own.initial_state(), second.initial_state()], []
    for coordinates in sorted(stated["coordinates"]):
        start, mu = time.perf_counter(), np.array(coordinates)
        states = [advance(p, state, mu)[-1] for p, state in zip((own, second), states, strict=True)]
        guess = np.zeros(third.n_dofs)
        guess[: 3 * third.displacements.n_scalar] = third.displacements.embedded(second.displacements, states[1].dofs)
        pairs.append([_figures(own, states[0]), _figures(third, solve(third, mu, State(mu, guess)))])
        print(f"{np.degrees(mu[0]):.1f} degrees: {time.perf_counter() - start:.0f} s")
    ours, true = zip(*pairs, strict=True)
    errors = {name: [a[name] - b[name] for a, b in zip(ours, true, strict=True)] for name in ours[0]}
    norms = {name: np.sqrt(sum(np.sum(b[name] ** 2) for b in true)) for name in errors}
    relative = {name: np.sqrt(sum(np.sum(e**2) for e in values)) / norms[name] for name, values in errors.items()}
    said = stated["errors"]
    mean = 1e3 * np.mean(np.linalg.norm(errors["displacement"], axis=2))
    moment = said["reaction_moment_top"]["relative_l2"] / relative["moment"]
    print(
        f"nodes={own.mesh.n_nodes} states={len(pairs)} unknowns={third.n_dofs} "
        f"mean_mm={mean:.4f} von_mises_percent={100.0 * relative['von_mises']:.2f}\n"
        f"effectivity: displacement={said['displacement']['mean_mm'] / mean:.3f} "
        f"von_mises={said['stress_solid']['von_mises']['relative_l2'] / relative['von_mises']:.3f} moment={moment:.3f}"
    )


def _figures(problem: md.SolidProblem, state: State) -> dict[str, np.ndarray]:
    """Displacement, von Mises stress at the nodes and the moment about the origin that turns the top."""
    fields = problem.sample(state.dofs, state.mu)
    moment = problem.reactions(state.dofs, state.mu, "top", np.zeros(3))[1]
    return {"displacement": fields["displacement"], "von_mises": fields["von_mises"], "moment": moment}


if __name__ == "__main__":
    main()
    short_builds()
