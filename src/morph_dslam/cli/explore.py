"""`morph explore`: a model in the browser, with a slider for each parameter."""

import argparse

from morph_dslam.cli.arguments import add_file, add_flag

HELP = "show a model in the browser, deformed and coloured by stress, with a slider for each parameter"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file")
    command.add_argument(
        "--port", type=int, default=8765, metavar="N", help="on this computer; 0: any (default: %(default)s)"
    )
    add_flag(command, "--open", "open the browser at once")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import explore

    explore(arguments.model, arguments.port, arguments.open)
