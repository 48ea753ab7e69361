"""`morph export`: a model's deformed states for other programs."""

import argparse
from pathlib import Path

from morph_dslam.cli.arguments import add_file, add_output, add_repeated

HELP = "write a model's deformed states for ParaView (XDMF, VTU) or 3-D viewers (glTF)"
KEPT = "the states written so far, if any, are kept with their table; of a glTF file nothing"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file")
    add_output(command, "FOLDER", "folder to write")
    command.add_argument("--format", choices=("xdmf", "vtu", "gltf"), default="xdmf", help="default: %(default)s")
    command.add_argument(
        "--show",
        choices=("stress", "strain", "displacement", "none"),
        help="what colours a glTF file: von Mises stress (the default), equivalent strain, displacement, or nothing",
    )
    add_repeated(
        command,
        "--vary",
        "values of a parameter, in its own unit; several make a grid (default: each in turn)",
        "NAME=FROM:TO:COUNT",
    )
    add_file(
        command, "--path", "states of the frames of a run, or of the rows of a table (docs/export.md)", "RUN_OR_CSV"
    )
    add_repeated(command, "--at", "value of a parameter that is not varied (default: its default)", "NAME=VALUE")
    add_repeated(
        command, "--inner", "with --format vtu or gltf: a structure inside (`morph inner`) to write too", "FILE", Path
    )
    command.add_argument(
        "--coordinates",
        choices=("object", "camera"),
        default="object",
        help="with --format vtu and the path of a run: camera puts the object where the camera saw it in each frame "
        "(default: %(default)s)",
    )


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import StateChoice, export

    choice = StateChoice(arguments.vary, arguments.path, arguments.at, arguments.coordinates)
    target = export(
        arguments.model,
        arguments.output,
        arguments.format,
        choice,
        arguments.show,
        tell=lambda notice: print(f"note: {notice}"),
        inner=arguments.inner,
    )
    print(f"wrote {target} and {arguments.output / 'states.csv'}")
