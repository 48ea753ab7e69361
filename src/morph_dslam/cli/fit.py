"""`morph fit`: a material law from stress-strain tables of own tests."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from morph_dslam.cli.arguments import add_flag, add_output, add_repeated
from morph_dslam.errors import IdentificationError

HELP = "fit rubber laws to stress-strain tables of material tests"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    for kind, text in (
        ("uniaxial", "tension or compression of a bar"),
        ("biaxial", "equal tension in two directions"),
        ("planar", "tension of a wide strip that keeps its width (pure shear)"),
    ):
        add_repeated(command, f"--{kind}", f"a test in {text}, CSV (docs/material-tests.md)", "CSV", Path)
    add_repeated(command, "--law", "a law to fit; without it the usual ones are compared", "LAW")
    command.add_argument(
        "--prony", type=_terms, default=0, metavar="N", help="a Prony series of N terms over the law, from times"
    )
    command.add_argument("--name", type=_name, default="fitted", help="of the material in the study (%(default)s)")
    add_flag(command, "--overwrite", "replace a fit that is in the folder")
    add_output(command, "OUT", "folder to write")


def _terms(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 5:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of terms from 1 to 5")
    return int(text)


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", text):
        raise argparse.ArgumentTypeError(f"'{text}' is not a name of letters, digits, _ and -")
    return text


def run(arguments: argparse.Namespace) -> None:
    """Fit and print the laws."""
    from tqdm import tqdm

    from morph_dslam.extend.material_tests import (
        KINDS,
        USUAL,
        check_no_fit,
        fit_candidate,
        fit_last_line,
        fit_lines,
        load_test,
        write_fit,
    )

    files = [(kind, path) for kind in KINDS for path in getattr(arguments, kind)]
    if not files:
        raise IdentificationError("give at least one test, --uniaxial tension.csv say")
    if len({path.resolve() for _, path in files}) < len(files):
        raise IdentificationError("a test is given twice: its values would count twice")
    check_no_fit(arguments.output, arguments.overwrite)
    tests = [load_test(path, kind) for kind, path in files]
    names = list(dict.fromkeys(arguments.law)) or list(USUAL)
    fitted = [fit_candidate(name, tests, arguments.prony) for name in tqdm(names, desc="fitting", leave=False)]
    figures = write_fit(arguments.output, fitted, tests, arguments.name)
    for line in fit_lines(figures):
        print(line)
    print(f"wrote {arguments.output / 'material.toml'}, fit.json and fit.png")
    print(fit_last_line(figures))
