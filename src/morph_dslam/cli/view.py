"""Commands that show a model elsewhere: `morph export` to other programs, `morph explore` in the browser."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def _export(arguments: argparse.Namespace) -> None:
    from morph_dslam.export import StateChoice, export

    choice = StateChoice(arguments.vary, arguments.path, arguments.at)
    target = export(arguments.model, arguments.output, arguments.format, choice)
    print(f"wrote {target} and {arguments.output / 'states.csv'}")


def _explore(arguments: argparse.Namespace) -> None:
    from morph_dslam.explore.server import explore

    explore(arguments.model, arguments.port, arguments.open)


def add_view_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add both commands; ``add(name, action, kept, text)`` makes the parser of one."""
    export = add(
        "export",
        _export,
        "the files written so far are kept",
        "write a model's deformed states for ParaView (XDMF, VTU) or 3-D viewers (glTF)",
    )
    export.add_argument("model", type=Path, help="model file")
    export.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")
    export.add_argument("--format", choices=("xdmf", "vtu", "gltf"), default="xdmf", help="default: %(default)s")
    export.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="NAME=FROM:TO:COUNT",
        help="values of a parameter, in its own unit; several make a grid (default: each in turn)",
    )
    export.add_argument("--path", type=Path, metavar="CSV", help="states from a table (docs/export.md)")
    export.add_argument(
        "--at",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a parameter that is not varied (default: its default)",
    )
    explore = add(
        "explore",
        _explore,
        "nothing was written",
        "show a model in the browser, deformed and coloured by stress, with a slider for each parameter",
    )
    explore.add_argument("model", type=Path, help="model file")
    explore.add_argument(
        "--port", type=int, default=8765, metavar="N", help="on this computer; 0: any (default: %(default)s)"
    )
    explore.add_argument("--open", action="store_true", help="open the browser at once")
