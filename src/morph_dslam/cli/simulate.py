"""`morph simulate`: film a model moving, with exact truth."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "film a model moving through given parameters and camera positions, with exact truth"
KEPT = "the frames written so far are kept, without truth"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("scene", type=Path, help="scene file (docs/scene-file.md)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.render.simulation import simulate

    simulate(arguments.scene, arguments.output)
