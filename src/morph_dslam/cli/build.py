"""`morph build`: a study becomes a model file and a report, or a surface the model file of a rigid object."""

import argparse
import warnings
from pathlib import Path

from morph_dslam.cli.arguments import LENGTH_UNITS, add_file, add_output, positive_integer
from morph_dslam.errors import StudyError

HELP = "solve a study over its parameters and compress the solutions in a model file, or make one of a rigid surface"
#: Ends of the names of surface files.
SURFACES = (".stl", ".obj", ".ply")
KEPT = "the solutions found so far, if any, are kept, and the same command goes on from there"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "study",
        type=Path,
        nargs="?",
        metavar="STUDY",
        help="study file, or the folder of a file study.toml (docs/study-file.md, solid-study.md, shell-study.md)",
    )
    add_file(command, "--rigid", ".stl, .obj or .ply file of a rigid object, in place of a study", "SURFACE")
    command.add_argument("--unit", choices=LENGTH_UNITS, help="unit of that file's coordinates")
    add_output(command, "MODEL", "model file to write")
    command.add_argument(
        "--workers",
        type=positive_integer,
        metavar="N",
        help="processes to solve in (default: the study's number, else 1 for solids, one a core for sheets and shells)",
    )
    add_file(
        command,
        "--reference-curve",
        "errors of another program by number of modes, drawn in the report (docs/certificate.md)",
        "CSV",
    )


def run(arguments: argparse.Namespace) -> None:
    """Build the model, and write its report if it has a study."""
    if (arguments.study is None) == (arguments.rigid is None):
        raise StudyError("give a study file, or --rigid with the surface of a rigid object: one of both")
    if arguments.output.is_dir():
        raise StudyError(f"{arguments.output} is a folder: give the name of the model file to write")
    if arguments.rigid is None:
        _build_study(arguments)
    else:
        _build_rigid(arguments)


def _build_study(arguments: argparse.Namespace) -> None:
    if arguments.unit is not None:
        raise StudyError("--unit is of a surface (--rigid); a study file states its units itself")
    if arguments.study.suffix.lower() in SURFACES:
        raise StudyError(
            f"{arguments.study} is a surface, not a study file: a rigid object is built with --rigid "
            f"{arguments.study.name} and --unit, and a deformable one from a study that names the file as its mesh"
        )
    build_study(arguments.study, arguments.output, arguments.workers, arguments.reference_curve)


def build_study(study: Path, output: Path, workers: int | None = None, curve: Path | None = None) -> None:
    """Build the model of a study file, write its report, and print what came of it."""
    from morph_dslam import build, write_build_report
    from morph_dslam.extend.mechanics import NearlyIncompressibleWarning
    from morph_dslam.extend.models import check_no_input
    from morph_dslam.extend.reduction import read_reference_curve, report_path
    from morph_dslam.extend.reports import error_facts
    from morph_dslam.extend.studies import build_warnings

    check_no_input([output], [curve], StudyError)
    reference = None if curve is None else read_reference_curve(curve)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearlyIncompressibleWarning)  # printed once, at the end
        model = build(study, output, workers)
    write_build_report(report_path(output), model, reference)
    print(f"wrote {output} and {report_path(output)}")
    for name, words in error_facts(model).items():
        if name.endswith("error"):
            print(f"{name}: {words}")
    for line in build_warnings(model.certificate):
        print(f"warning: {line}")


def _build_rigid(arguments: argparse.Namespace) -> None:
    from morph_dslam.extend.studies import build_rigid, repairs_in_words

    if arguments.unit is None:
        raise StudyError(f"say in which unit {arguments.rigid} was drawn: --unit {', '.join(LENGTH_UNITS)}")
    if arguments.workers is not None or arguments.reference_curve is not None:
        raise StudyError("--workers and --reference-curve are for studies; leave them out with --rigid")
    model = build_rigid(arguments.rigid, arguments.unit, arguments.output)
    extent = " x ".join(
        f"{1e3 * (high - low):.4g}" for low, high in zip(model.nodes.min(axis=0), model.nodes.max(axis=0), strict=True)
    )
    print(f"wrote {arguments.output}: rigid, {len(model.triangles)} triangles, {extent} mm")
    for repair in repairs_in_words(model.provenance["repairs"]):
        print(f"repair: {repair}")
    if not model.provenance["repairs"]:
        print("the surface is closed and needed no repair")
