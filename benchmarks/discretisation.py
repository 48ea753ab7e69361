"""The discretisation error that a certificate states, against finer meshes and against what it is an estimate of.

Bars and plates of hexahedra, one and two cells thick, are clamped at one end and pushed sideways at the other. The
truth is a mesh of second order that is three times as fine. The effectivity of an error is what the certificate states
over what the truth says: 1 is perfect. That of the load has a sign: whether elements are too stiff or too soft. Four
builds of 28 to 30 solves follow: their estimates, whose finer solves end early, against the same finer elements
solved from the defaults to the end.
Run: python benchmarks/discretisation.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import morph_dslam as md
from morph_dslam.extend.mechanics import SolidOptions, loaded_state

HEIGHT, RADIUS, DEPTH, FOLDS = 90.0, 30.0, 4.0, 4
#: By name: size (mm), push (kPa), the cells of the truth, and those of the meshes that are compared with it.
THIN = {
    "bar": ((20, 20, 60), 20.0, [3, 3, 9], ([1, 1, 3], [1, 1, 6], [2, 2, 6])),
    "plate": ((4, 20, 60), 0.4, [2, 4, 12], ([1, 2, 4], [1, 3, 8], [2, 3, 8])),
}


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


def thin(size: tuple[int, int, int], push: float, divisions: list[int], cells: str, poisson: float) -> Any:
    """A bar or plate, pushed sideways along its thickness."""
    return md.make_study(
        {
            "name": "thin",
            "mesh": {
                "generator": "block",
                "size": [f"{side} mm" for side in size],
                "divisions": divisions,
                "cells": cells,
            },
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": poisson}},
            "supports": [{"kind": "fixed", "on": "z_min"}],
            "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "0 Pa"]}],
            "parameters": {"push": {"range": ["0 kPa", f"{push} kPa"]}},
            "sampling": {"held_out": 6, "refined": 1},
            "solver": {"workers": 1, "threads": 1},
        }
    )


def thin_meshes() -> None:
    """Print the effectivity of the estimates on meshes of few cells."""
    for name, (size, push, fine, meshes) in THIN.items():
        for poisson in (0.3, 0.45):
            true = thin(size, push, fine, "hex27", poisson).problem(SolidOptions(threads=1))
            for divisions in meshes:
                study = thin(size, push, divisions, "hex8", poisson)
                with tempfile.TemporaryDirectory() as folder:
                    model = md.build(study, Path(folder) / "thin.morph")
                stated = model.certificate["discretisation"]
                mu = np.array(stated["coordinates"][0])
                own = study.problem(SolidOptions(threads=1))
                found, truth = (p.nodal_displacement(loaded_state(p, mu).dofs) for p in (own, true))
                apart = np.linalg.norm(true.mesh.nodes[None] - own.mesh.nodes[:, None], axis=2)
                missing = truth[apart.argmin(axis=1)] - found
                mean = 1e3 * np.linalg.norm(missing, axis=1).mean()
                load = mu[0] * np.sum(found * missing) / np.sum(found**2)
                print(
                    f"{name}, Poisson's ratio {poisson}, {' x '.join(map(str, divisions))} cells: "
                    f"displacement={stated['errors']['displacement']['mean_mm'] / mean:.2f} "
                    f"load={stated['parameters']['errors']['push'][0] / load:.2f} "
                    f"true_load_percent={100.0 * load / mu[0]:.2f}"
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
        # All of them are of third order: one more than tet10 has, two more than hexahedra with enhanced strains.
        finer, pairs = study.problem(SolidOptions(order=3, serendipity=True, at_nodes=True)), []
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


if __name__ == "__main__":
    thin_meshes()
    short_builds()
