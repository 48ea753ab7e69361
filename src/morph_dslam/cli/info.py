"""`morph info`: what a model file holds."""

import argparse

from morph_dslam.cli.arguments import add_file

HELP = "print what a model file holds"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam import load_model
    from morph_dslam.extend.reports import summarise_model

    model = load_model(arguments.model)
    print(f"{model.name}: a reduced model of {arguments.model.stat().st_size / 1e6:.2f} MB")
    for heading, table in summarise_model(model).items():
        print(f"\n{heading}")
        for line in table.text():
            print(f"  {line}")
