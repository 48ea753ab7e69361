"""Commands for structures inside of a solid: `morph inner`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def _inner(arguments: argparse.Namespace) -> None:
    from morph_dslam.model import load_model
    from morph_dslam.model.inner_structure import save_inner_structure
    from morph_dslam.offline.inner_structures import read_inner_structure

    model = load_model(arguments.model)
    name = arguments.name or arguments.surface.stem
    structure = read_inner_structure(model, name, arguments.surface, arguments.unit)
    save_inner_structure(arguments.output, structure)
    print(f"wrote {arguments.output}: '{name}', {len(structure.rest)} nodes inside of '{model.name}'")


def add_inner_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command; ``add(name, action, kept, text)`` makes its parser."""
    inner = add(
        "inner",
        _inner,
        "nothing was written",
        "place a surface (a tumour, a vessel) inside of a solid, to be carried along by its model",
    )
    inner.add_argument("surface", type=Path, help=".stl, .obj or .ply file, drawn in the object's frame")
    inner.add_argument("--model", type=Path, required=True, help="model file of the solid")
    inner.add_argument(
        "--unit", required=True, choices=("m", "cm", "mm"), help="unit of the file's coordinates"
    )
    inner.add_argument("--name", help="shown in results and video (default: the file's name)")
    inner.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")
