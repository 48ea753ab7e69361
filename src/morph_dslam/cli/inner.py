"""`morph inner`: a structure inside of a solid."""

import argparse

from morph_dslam.cli.arguments import LENGTH_UNITS, add_file, add_output
from morph_dslam.errors import StudyError

HELP = "place a surface (a tumour, a vessel) inside of a solid, to be carried along by its model"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "surface", ".stl, .obj or .ply file, drawn in the object's frame")
    add_file(command, "--model", "model file of the solid", required=True)
    command.add_argument("--unit", required=True, choices=LENGTH_UNITS, help="unit of the file's coordinates")
    command.add_argument("--name", help="shown in results and video (default: the file's name)")
    add_output(command, "FILE", "file to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import load_model
    from morph_dslam.extend.models import check_no_input, save_inner_structure
    from morph_dslam.extend.studies import described_inner, inner_size_note, read_inner_structure

    check_no_input([arguments.output], [arguments.model, arguments.surface], StudyError)
    model = load_model(arguments.model)
    name = arguments.name or arguments.surface.stem
    structure = read_inner_structure(model, name, arguments.surface, arguments.unit)
    save_inner_structure(arguments.output, structure)
    place = described_inner(structure)
    print(f"wrote {arguments.output}: '{name}', {len(structure.rest)} nodes inside of '{model.name}', {place}")
    note = inner_size_note(model, structure, arguments.unit)
    if note is not None:
        print(f"note: {note}")
