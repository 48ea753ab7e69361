"""`morph info`: what a model file holds."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "print what a model file holds"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("model", type=Path, help="model file")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import load_model
    from morph_dslam.evaluation.model_summary import summarise_model

    model = load_model(arguments.model)
    print(f"{model.name}: a reduced model of {arguments.model.stat().st_size / 1e6:.2f} MB")
    for heading, table in summarise_model(model).items():
        print(f"\n{heading}")
        for line in table.text():
            print(f"  {line}")
