"""`morph inner`: a structure inside of a solid."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "place a surface (a tumour, a vessel) inside of a solid, to be carried along by its model"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("surface", type=Path, help=".stl, .obj or .ply file, drawn in the object's frame")
    command.add_argument("--model", type=Path, required=True, help="model file of the solid")
    command.add_argument("--unit", required=True, choices=("m", "cm", "mm"), help="unit of the file's coordinates")
    command.add_argument("--name", help="shown in results and video (default: the file's name)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import load_model
    from morph_dslam.model.inner_structure import save_inner_structure
    from morph_dslam.studies.inner_structures import read_inner_structure

    model = load_model(arguments.model)
    name = arguments.name or arguments.surface.stem
    structure = read_inner_structure(model, name, arguments.surface, arguments.unit)
    save_inner_structure(arguments.output, structure)
    print(f"wrote {arguments.output}: '{name}', {len(structure.rest)} nodes inside of '{model.name}'")
