"""`morph simulate`: film a model moving, with exact truth."""

import argparse

from morph_dslam.cli.arguments import add_file, add_output

HELP = "film a model moving through given parameters and camera positions, with exact truth"
KEPT = "the frames written so far are kept, without truth"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "scene", "scene file (docs/scene-file.md)")
    add_output(command, "FOLDER", "folder to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import simulate

    simulate(arguments.scene, arguments.output)
