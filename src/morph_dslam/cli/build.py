"""`morph build`: a study becomes a model file and a report."""

import argparse
import warnings

from morph_dslam.cli.arguments import add_file, add_output, positive_integer
from morph_dslam.errors import StudyError

HELP = "solve a study over its parameters and compress the solutions in a model file"
KEPT = "the solutions found so far are kept, and the same command goes on from there"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "study", "study file (docs/study-file.md)")
    add_output(command, "MODEL", "model file to write")
    command.add_argument(
        "--workers", type=positive_integer, metavar="N", help="processes to solve in (default: one a core)"
    )
    add_file(
        command,
        "--reference-curve",
        "errors of another program by number of modes, drawn in the report (docs/certificate.md)",
        "CSV",
    )


def run(arguments: argparse.Namespace) -> None:
    """Build the model and write its report."""
    from morph_dslam import build, write_build_report
    from morph_dslam.extend.mechanics import NearlyIncompressibleWarning
    from morph_dslam.extend.reduction import read_reference_curve, report_path
    from morph_dslam.extend.studies import build_warnings

    output = arguments.output
    if output.is_dir():
        raise StudyError(f"{output} is a folder: give the name of the model file to write")
    reference = None if arguments.reference_curve is None else read_reference_curve(arguments.reference_curve)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearlyIncompressibleWarning)  # printed once, at the end
        model = build(arguments.study, output, arguments.workers)
    write_build_report(report_path(output), model, reference)
    print(f"wrote {output} and {report_path(output)}")
    for line in build_warnings(model.certificate):
        print(f"warning: {line}")
