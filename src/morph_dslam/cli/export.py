"""`morph export`: a model's deformed states for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "write a model's deformed states for ParaView (XDMF, VTU) or 3-D viewers (glTF)"
KEPT = "the files written so far are kept"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("model", type=Path, help="model file")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")
    command.add_argument("--format", choices=("xdmf", "vtu", "gltf"), default="xdmf", help="default: %(default)s")
    command.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=FROM:TO:COUNT",
        help="values of a parameter, in its own unit; several make a grid (default: each in turn)",
    )
    command.add_argument("--path", type=Path, metavar="CSV", help="states from a table (docs/export.md)")
    command.add_argument(
        "--at",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a parameter that is not varied (default: its default)",
    )


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.export import StateChoice, export

    choice = StateChoice(arguments.vary, arguments.path, arguments.at)
    target = export(arguments.model, arguments.output, arguments.format, choice)
    print(f"wrote {target} and {arguments.output / 'states.csv'}")
