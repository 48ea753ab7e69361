"""Contact: Hertz's sphere, a ring beside CalculiX, a seal whose folds touch, and what kinks cost a reduced model.

The seal is half of examples/boot_seal with coarser cells, turned by 52 degrees with and without contact of its surfaces
with themselves; its depth is that of the deepest node that the certificate would name. The ring's figure is the largest
deviation of its force from CalculiX's, which peers/calculix_ring.py computes.
Run: python benchmarks/contact.py
"""

from __future__ import annotations

import tempfile
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

import morph_dslam as md
from morph_dslam.extend.mechanics import (
    LinearElastic,
    ParameterSymbols,
    PrescribedDisplacement,
    RigidSphere,
    advance,
    block,
    fixed,
    model_mesh_of,
    save_mesh,
)
from morph_dslam.extend.reduction import penetration_report
from morph_dslam.extend.studies import Snapshot, SolidStudy
from peers import calculix_ring

SEAL = Path(__file__).resolve().parents[1] / "examples" / "boot_seal" / "study.toml"
YOUNG, POISSON, RADIUS, DEPTH = 1e6, 0.3, 1.0, 0.0025


def hertz(cells: int) -> tuple[float, float]:
    """Radius of contact and peak pressure of a sphere on a block, over Hertz's for the same force."""
    mesh = block((1.0, 1.0, 1.0), (cells, cells, cells), "hex8")
    shares = np.where([True, True, False], mesh.nodes, 1.0 - mesh.nodes)
    graded = 0.015 * np.sinh(np.arcsinh(1.0 / 0.015) * shares)
    mesh = replace(mesh, nodes=np.where([True, True, False], graded, 1.0 - graded))
    symbols = ParameterSymbols([md.Parameter("depth", "length", "m", 0.0, 0.01, 0.0)])
    sphere = RigidSphere("z_max", (0.0, 0.0, 1.0 + RADIUS - symbols["depth"]), RADIUS)
    supports = [fixed("z_min"), PrescribedDisplacement("x_min", x=0.0), PrescribedDisplacement("y_min", y=0.0)]
    solid = {"all": LinearElastic(young=YOUNG, poisson=POISSON)}
    problem = md.SolidProblem(mesh, solid, supports, [], symbols, contacts=[sphere])
    state = advance(problem, problem.initial_state(), np.array([DEPTH]))[-1]
    force = 4.0 * problem.reactions(state.dofs, state.mu, "z_min")[0][2]
    radius = (3.0 * force * RADIUS * (1.0 - POISSON**2) / (4.0 * YOUNG)) ** (1.0 / 3.0)
    pressed = -problem.contact_forces(state.dofs, state.mu, 0)[2]
    square = pressed @ (problem.displacements.coefficients @ mesh.nodes[:, 0] ** 2) / pressed.sum()
    centre = np.argmin(np.linalg.norm(mesh.nodes - [0.0, 0.0, 1.0], axis=1))
    peak = -problem.sample(state.dofs, state.mu)["stress"][centre, 2]
    return np.sqrt(5.0 * square) / radius, peak / (3.0 * force / (2.0 * np.pi * radius**2))


def ring() -> float:
    """Largest deviation (%) of the force on a ring that touches itself from CalculiX's."""
    with tempfile.TemporaryDirectory() as name:
        mesh = Path(name) / "ring.inp"
        save_mesh(mesh, calculix_ring.half_ring(), "mm")
        made = md.make_study(calculix_ring.study(mesh))
        assert isinstance(made, SolidStudy)
        problem = made.problem()
    state, deviations = problem.initial_state(), []
    for push, expected in calculix_ring.REFERENCE:
        state = advance(problem, state, np.array([push / 1e3]))[-1]
        force = -problem.reactions(state.dofs, state.mu, "end")[0][1]
        deviations.append(100.0 * abs(force / expected - 1.0))
        print(f"ring pushed by {push} mm: {force:.5f} N, CalculiX {expected:.5f} N", flush=True)
    return max(deviations)


def seal(contact: bool) -> tuple[float, float]:
    """Depth (mm) of the deepest node of half a seal inside another part of it at 52 degrees, and seconds."""
    study = tomllib.loads(SEAL.read_text())
    study["mesh"] |= {"divisions": [51, 2, 12], "angles": ["0 deg", "180 deg"]}
    study["supports"] += [{"kind": "displacement", "on": cut, "y": "0 mm"} for cut in ("start", "end")]
    study["solver"] = {"threads": 1}
    if contact:
        study["contacts"] = [{"kind": "surface", "on": "outer"}, {"kind": "surface", "on": "inner"}]
    made = md.make_study(study)
    assert isinstance(made, SolidStudy)
    problem = made.problem()
    begin, state = time.perf_counter(), problem.initial_state()
    for angle in np.radians(np.arange(4.0, 52.1, 4.0)):
        state = advance(problem, state, np.array([angle]))[-1]
    seconds = time.perf_counter() - begin
    mesh = model_mesh_of(problem.mesh)
    solution = Snapshot(state.mu, {"displacement": problem.nodal_displacement(state.dofs)})
    report = penetration_report(mesh, problem.symbols.parameters, [solution])
    assert report is not None
    print(f"{len(mesh.nodes)} nodes, {seconds:.1f} s: {report['statement']}", flush=True)
    return max((found["depth_mm"] for found in report["states"]), default=0.0), seconds


def reduced(first: str) -> tuple[float, float]:
    """Mean (mm) and relative norm (%) of a reduced model's errors: a block under a ball, 8 mm deep at most."""
    study = {
        "name": "pressed block",
        "mesh": {
            "generator": "block",
            "size": ["100 mm", "100 mm", "30 mm"],
            "divisions": [10, 10, 3],
            "cells": "hex8",
        },
        "materials": {"silicone": {"law": "neo_hookean", "young": "0.1 MPa", "poisson": 0.45}},
        "supports": [{"kind": "fixed", "on": "z_min"}],
        "parameters": {"depth": {"range": [first, "8 mm"]}, "place": {"range": ["35 mm", "65 mm"], "default": "50 mm"}},
        "contacts": [
            {"kind": "sphere", "on": "z_max", "centre": ["place", "50 mm", "45 mm - depth"], "radius": "15 mm"}
        ],
        "sampling": {"training": 40, "held_out": 12, "refined": 0},
        "solver": {"workers": 1, "threads": 1},
    }
    found = md.build(md.make_study(study)).certificate["displacement"]
    return found["mean_mm"], 100.0 * found["relative_l2"]


def main() -> None:
    radius, peak = hertz(16)
    print(f"hertz: radius {radius:.4f}, peak pressure {peak:.4f} of the closed form's", flush=True)
    from_calculix = ring()
    touching, coming = reduced("3 mm"), reduced("-4 mm")
    for where, (mean, share) in {"in contact": touching, "from 4 mm above": coming}.items():
        print(f"reduced model, {where}: {mean:.3f} mm in the mean, {share:.1f} %", flush=True)
    (deepest, without), (depth, seconds) = seal(False), seal(True)
    print(
        f"hertz_radius={radius:.4f} hertz_peak={peak:.4f} ring_percent={from_calculix:.2f} seal_depth_mm={depth:.4f} "
        f"seal_depth_without_mm={deepest:.3f} time_ratio={seconds / without:.2f} "
        f"reduced_percent={touching[1]:.1f} reduced_from_above_percent={coming[1]:.1f}"
    )


if __name__ == "__main__":
    main()
