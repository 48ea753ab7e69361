"""A ring that is bent until it touches itself, in CalculiX, for a comparison with the project's contact.

Half of a rubber ring in plane strain, its wall thicker below than above: the uppermost section is pushed down, the one
40 degrees from the lowest is held, and the inner surface meets itself where nothing is plane. Elements are of second
order (C3D20), contact is of faces with a linear penalty. `REFERENCE` are CalculiX's figures.
Run: python benchmarks/peers/calculix_ring.py, with CalculiX (ccx) installed: prints the rows of REFERENCE.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.extend.mechanics import Mesh, save_mesh, tube

#: Inner and outer radius, and by how much the hole is off the centre, mm.
INNER, OUTER, OFFSET = 9.25, 10.75, 0.2
#: MPa: constants of the Mooney-Rivlin law with c01 = 0.
C10, BULK = 0.5, 4.0
#: Push (mm) and its force on the half of a slice of 1 mm (N), by CalculiX 2.20. The walls meet at 18 mm.
REFERENCE = ((10.0, 0.02728), (18.0, 0.02466), (19.0, 0.07924), (20.0, 0.24765), (21.0, 0.46943))
#: Penalty in CalculiX, MPa/mm.
_STIFFNESS = 500.0
#: Faces of the halves that CalculiX lets meet are above and below it, mm: it would find contact of neighbours.
_MEETING = 5.0


def half_ring() -> Mesh:
    """The half x > 0, m."""
    mesh = tube(INNER / 1e3, OUTER / 1e3, 1e-3, (1, 3, 90), "hex20", (-np.pi / 2.0, np.pi / 2.0))
    nodes, radius = mesh.nodes.copy(), 1e3 * np.hypot(*mesh.nodes[:, :2].T)
    angle = np.degrees(np.arctan2(nodes[:, 1], nodes[:, 0]))
    sets = {name: mesh.set_nodes(name) for name in ("start", "end")}
    sets |= {"held": np.flatnonzero(np.abs(angle + 50.0) < 1e-6), "sides": np.flatnonzero(nodes[:, 2] % 1e-3 == 0.0)}
    nodes[:, 1] += OFFSET / 1e3 * (OUTER - radius) / (OUTER - INNER)
    inner, height = mesh.surface("inner"), nodes[mesh.face_nodes(mesh.surface("inner"))][:, :, 1].mean(axis=1)
    surfaces = {"inner": inner, "upper": inner[1e3 * height > _MEETING], "lower": inner[1e3 * height < -_MEETING]}
    whole = {"ring": np.arange(mesh.n_cells)}
    return replace(mesh, nodes=nodes, node_sets=sets, cell_sets=whole, surfaces=surfaces)


def study(mesh: Path) -> dict[str, Any]:
    """The ring as a study, from a file of its mesh in mm."""
    motions = {
        "sides": {"z": "0 mm"},
        "start": {"x": "0 mm"},
        "held": {"x": "0 mm", "y": "0 mm"},
        "end": {"x": "0 mm", "y": "-push"},
    }
    return {
        "name": "bent ring",
        "mesh": {"file": str(mesh), "unit": "mm"},
        "materials": {"rubber": {"law": "mooney_rivlin", "c10": f"{C10} MPa", "bulk": f"{BULK} MPa"}},
        "parameters": {"push": {"range": ["0 mm", "21 mm"], "default": "0 mm"}},
        "supports": [{"kind": "displacement", "on": on} | motion for on, motion in motions.items()],
        "contacts": [{"kind": "surface", "on": "inner"}],
        "solver": {"threads": 1},
    }


def deck(mesh: str) -> str:
    """CalculiX's input beside a mesh file, in mm and MPa: a step to each push."""
    lines = [f"*INCLUDE, INPUT={mesh}", "*MATERIAL, NAME=RUBBER", "*HYPERELASTIC, NEO HOOKE", f"{C10}, {2.0 / BULK}"]
    lines += ["*SOLID SECTION, ELSET=ring, MATERIAL=RUBBER", "*SURFACE INTERACTION, NAME=SOFT"]
    lines += ["*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{_STIFFNESS}"]
    lines += ["*CONTACT PAIR, INTERACTION=SOFT, TYPE=SURFACE TO SURFACE", "upper, lower"]
    lines += ["*BOUNDARY", "sides, 3, 3", "start, 1, 1", "held, 1, 2", "end, 1, 1"]
    for push, _ in REFERENCE:
        lines += ["*STEP, NLGEOM, INC=1000", "*STATIC", "0.05, 1.0, 1e-6, 0.1", "*BOUNDARY", f"end, 2, 2, -{push}"]
        lines += ["*NODE PRINT, NSET=end, TOTALS=ONLY, FREQUENCY=1000", "RF", "*END STEP"]
    return "\n".join(lines) + "\n"


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_mesh(folder / "ring.inp", half_ring(), "mm")
        (folder / "run.inp").write_text(deck("ring.inp"))
        subprocess.run(["ccx", "-i", "run"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        totals = re.findall(r"set END and time.*\n\n(.*)", (folder / "run.dat").read_text())
    for (push, _), total in zip(REFERENCE, totals, strict=True):
        print(f"({push}, {-float(total.split()[1]):.5f}),")


if __name__ == "__main__":
    main()
