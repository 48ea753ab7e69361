"""Reduced models of the hanging bar, with the softness of the silicone as their parameter."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recording import CLAMP_X, HangingBar

import morph_dslam as md
from morph_dslam.extend.mechanics import NearlyIncompressibleWarning
from morph_dslam.extend.studies import Study
from support import keep

HERE = Path(__file__).resolve().parent
#: Of the shear modulus over the published one: from 160 kPa to 20 kPa.
SOFTNESS = [0.313, 2.505]


@dataclass(frozen=True)
class Discretisation:
    """Which mesh of the recording, and which elements."""

    name: str
    mesh: str
    order: int
    formulation: str


#: As the published modulus was identified; the same elements, smaller; and elements that do not lock.
PUBLISHED = Discretisation("linear, published mesh", "cantilever_coarse/cantilever_f640_v322", 1, "displacement")
FINER = Discretisation("linear, finer mesh", "cantilever/cantilever_f1494_v749", 1, "displacement")
CONVERGED = Discretisation("second order, mixed", "cantilever/cantilever_f1494_v749", 2, "mixed")


def write_mesh(path: Path, bar: HangingBar) -> None:
    """Write the bar's tetrahedra and its clamped nodes as an Abaqus input file, in millimetres."""
    lines = ["*NODE"]
    lines += ["{}, {:.9g}, {:.9g}, {:.9g}".format(label, *node) for label, node in enumerate(1e3 * bar.nodes, 1)]
    lines.append("*ELEMENT, TYPE=C3D4")
    lines += [f"{label}, " + ", ".join(map(str, cell)) for label, cell in enumerate(bar.tetrahedra + 1, 1)]
    lines.append("*NSET, NSET=clamp")
    lines += [str(label) for label, node in enumerate(bar.nodes, 1) if node[0] > CLAMP_X - 1e-6]
    path.write_text("\n".join(lines) + "\n")


def bar_study(mesh: Path, discretisation: Discretisation) -> Study:
    """The bar under its weight."""
    return md.make_study(
        {
            "name": f"silicone bar, {discretisation.name}",
            "mesh": {"file": mesh.name, "unit": "mm"},
            "materials": {
                "silicone": {
                    "law": "user_material",
                    "function": f"{HERE / 'silicone.py'}:neo_hookean",
                    "softness": "softness",
                    "bulk": "2.5 MPa",
                    "density": "1080 kg/m3",
                }
            },
            "supports": [{"kind": "fixed", "on": "clamp"}],
            "loads": [{"kind": "gravity", "acceleration": ["0 m/s2", "-9.8 m/s2", "0 m/s2"]}],
            "parameters": {
                "softness": {"range": SOFTNESS, "description": "published shear modulus over the silicone's"}
            },
            "solver": {"order": discretisation.order, "formulation": discretisation.formulation},
            "sampling": {"scheme": "even", "training": 13, "held_out": 6},
            "reduction": {"method": "pod", "basis": "chebyshev", "tolerance": 1e-4},
        },
        mesh.parent,
    )


def bar_model(output: Path, bar: HangingBar, discretisation: Discretisation) -> md.ReducedModel:
    """Build the model, unless that was done from the same mesh and code."""
    stem = discretisation.name.replace(", ", "_").replace(" ", "_")
    mesh, model = output / f"{stem}.inp", output / f"{stem}.morph"
    write_mesh(mesh, bar)

    def make() -> None:
        with warnings.catch_warnings():
            # That linear tetrahedra lock is what this example is about.
            warnings.simplefilter("ignore", NearlyIncompressibleWarning)
            md.build(bar_study(mesh, discretisation), model)

    keep(model, [mesh, HERE / "silicone.py", HERE / "bar_models.py"], make)
    return md.load_model(model)
