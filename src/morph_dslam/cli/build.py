"""`morph build`: a study becomes a model file and a report."""

from __future__ import annotations

import argparse
import warnings
from contextlib import nullcontext
from pathlib import Path

from morph_dslam.cli.arguments import positive_integer
from morph_dslam.errors import StudyError

HELP = "solve a study over its parameters and compress the solutions in a model file"
KEPT = "the solutions found so far are kept, and the same command goes on from there"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("study", type=Path, help="study file (docs/study-file.md)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="MODEL", help="model file to write")
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=positive_integer, metavar="N", help="processes to solve in (default: one a core)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="solve on a Dask cluster, tcp://host:8786 say (docs/clusters.md)"
    )
    command.add_argument(
        "--reference-curve",
        type=Path,
        metavar="CSV",
        help="errors of another program by number of modes, drawn in the report (docs/certificate.md)",
    )


def run(arguments: argparse.Namespace) -> None:
    """Build the model and write its report."""
    from morph_dslam.reduction.report import report_path, write_build_report
    from morph_dslam.reduction.report_pictures import read_reference_curve
    from morph_dslam.studies.build import build, build_warnings

    output = arguments.output
    if output.is_dir():
        raise StudyError(f"{output} is a folder: give the name of the model file to write")
    reference = None if arguments.reference_curve is None else read_reference_curve(arguments.reference_curve)
    if arguments.scheduler is None:
        cluster = nullcontext()
    else:
        from morph_dslam.studies.executors import cluster_executor

        cluster = cluster_executor(arguments.scheduler)
    with cluster as executor, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* nearly incompressible")  # printed once, at the end
        model = build(arguments.study, output, arguments.workers, executor)
    write_build_report(report_path(output), model, reference)
    print(f"wrote {output} and {report_path(output)}")
    for line in build_warnings(model.certificate):
        print(f"warning: {line}")
