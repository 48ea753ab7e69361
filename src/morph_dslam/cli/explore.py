"""`morph explore`: a model in the browser, with a slider for each parameter."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "show a model in the browser, deformed and coloured by stress, with a slider for each parameter"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("model", type=Path, help="model file")
    command.add_argument(
        "--port", type=int, default=8765, metavar="N", help="on this computer; 0: any (default: %(default)s)"
    )
    command.add_argument("--open", action="store_true", help="open the browser at once")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.explore.server import explore

    explore(arguments.model, arguments.port, arguments.open)
