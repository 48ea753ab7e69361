"""`morph info`: what a model file holds, and which sets the mesh of a study or of a mesh file has."""

import argparse

from morph_dslam.cli.arguments import LENGTH_UNITS, add_file, positive_number

HELP = "print what a model file holds, or the size and the named sets of a study's mesh or of a mesh file"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file, study file (.toml) or mesh file (docs/meshes.md)")
    command.add_argument("--unit", choices=LENGTH_UNITS, help="of a mesh file's coordinates (default: mm)")
    command.add_argument(
        "--size",
        type=positive_number,
        metavar="LENGTH",
        help="longest edge of a cell, in that unit, where a surface or a STEP file is meshed",
    )


def run(arguments: argparse.Namespace) -> None:
    """Print the model, or the sets of the mesh."""
    from morph_dslam.errors import StudyError
    from morph_dslam.extend.models import MESHES, file_kind

    is_mesh = file_kind(arguments.model) in MESHES
    if not is_mesh and (arguments.unit is not None or arguments.size is not None):
        raise StudyError(f"--unit and --size are of mesh files, and {arguments.model} is none: leave them out")
    if is_mesh or arguments.model.suffix == ".toml":
        _print_mesh(arguments)
    else:
        _print_model(arguments)


def _print_model(arguments: argparse.Namespace) -> None:
    from morph_dslam import load_model
    from morph_dslam.extend.reports import summarise_model

    model = load_model(arguments.model)
    print(f"{model.name}: a reduced model of {arguments.model.stat().st_size / 1e6:.2f} MB")
    for heading, table in summarise_model(model).items():
        print(f"\n{heading}")
        for line in table.text():
            print(f"  {line}")


def _print_mesh(arguments: argparse.Namespace) -> None:
    from morph_dslam.extend.mechanics import SET_COLUMNS, described_mesh, set_rows
    from morph_dslam.extend.reports import Table
    from morph_dslam.extend.studies import mesh_notes, mesh_of_file

    described = arguments.model, arguments.unit or "mm", arguments.size
    mesh = mesh_of_file(*described)
    print(f"{arguments.model}: {described_mesh(mesh)}")
    rows = set_rows(mesh)
    for line in Table(rows, SET_COLUMNS).text() if rows else ["no named sets"]:
        print(f"  {line}")
    for note in mesh_notes(*described, mesh):
        print(f"note: {note}")
