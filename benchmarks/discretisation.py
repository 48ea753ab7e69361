"""The discretisation error that a certificate states, against that of elements one order higher still.

A bellows of 2 457 nodes, linear hexahedra, turned by up to 52 degrees. The build solves held-out states again with
second order; here the same states are solved with third order. The effectivity of an error is what the certificate
states over what third order says: 1 is perfect.
Run: python benchmarks/discretisation.py
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import morph_dslam as md
from morph_dslam.extend.mechanics import SolidOptions, State, advance, solve

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
