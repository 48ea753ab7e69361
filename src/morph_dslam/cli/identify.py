"""`morph identify`: parameters that are one for a whole recording, from points and forces."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from morph_dslam.cli.arguments import add_file, add_flag, add_output, add_repeated, file_and_column
from morph_dslam.errors import IdentificationError

if TYPE_CHECKING:
    from morph_dslam import ReducedModel, Run
    from morph_dslam.extend.identification import MeasuredForces

HELP = "find moduli and other constant parameters from measured points and forces"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file of `morph build`", "MODEL")
    add_repeated(command, "--parameter", "a parameter of the model to identify", "NAME")
    add_flag(
        command,
        "--moduli",
        "identify a common factor of all moduli, from forces, or from points under loads of known size",
    )
    add_repeated(command, "--points", "points measured in some states, CSV (docs/identify.md)", "CSV", Path)
    add_repeated(
        command,
        "--force",
        "measured forces, CSV by frame of --run or by a parameter such as stroke_mm",
        "CURVE[:COLUMN]",
        file_and_column,
    )
    add_repeated(
        command, "--reaction", "the support of each --force, and x, +x, -x, y ... of the object frame", "SET:AXIS"
    )
    add_flag(command, "--no-offset", "the zero of the load cell is right: no offset is added to the model's forces")
    add_flag(command, "--align-points", "points were measured in another frame: one rigid motion of them is unknown")
    command.add_argument(
        "--run",
        dest="run_folder",
        type=Path,
        metavar="RUN",
        help="run folder of the video: its frames, and its estimates of per-sequence parameters",
    )
    add_flag(command, "--overwrite", "replace an identification that is in the folder")
    add_output(command, "OUT", "folder to write")


def run(arguments: argparse.Namespace) -> None:
    """Identify and print the estimates."""
    from morph_dslam import load_model, load_run
    from morph_dslam.extend.identification import (
        KnownValues,
        check_no_identification,
        identification_lines,
        identify,
        last_line,
        load_points,
        values_of_run,
        write_identification,
    )
    from morph_dslam.extend.models import with_unknown_loads

    if len(arguments.reaction) != len(arguments.force):
        raise IdentificationError("give one --reaction SET:AXIS for each --force, in the same order")
    check_no_identification(arguments.output, arguments.overwrite)
    model = load_model(arguments.model)
    folder: Path | None = arguments.run_folder
    tracked = None if folder is None else load_run(folder)
    if tracked is not None and tracked.model.n_loads and model.unknown_loads is not None and not arguments.parameter:
        # Forces of one model grow together by a factor of all moduli; a parameter would change what the loads explain.
        model = with_unknown_loads(model)
    _check_once([(path.resolve(),) for path in arguments.points])
    points = [
        replace(load_points(path, model, arguments.align_points), name=name)
        for path, name in zip(arguments.points, _distinct([(p, "points") for p in arguments.points]), strict=True)
    ]
    forces = _forces(arguments, model, tracked)
    prior, notes = KnownValues.none(), list[str]()
    if folder is not None and tracked is not None:
        prior, notes = values_of_run(folder, tracked, arguments.parameter, bool(points or forces))
    found = identify(model, [*points, *forces], arguments.parameter, arguments.moduli, prior)
    figures = write_identification(arguments.output, found)
    for line in [*identification_lines(figures), *notes]:
        print(line)
    by_frame = any(each.curve.against == "frame" for each in forces)
    if tracked is not None and not (by_frame or prior.names or notes):
        print(
            "note: --run changes nothing here: no forces are given by frame, and no parameter to identify is one that "
            "the run found for its whole sequence"
        )
    print(f"wrote {arguments.output / 'identification.json'} and identification.png")
    print(last_line(figures))


def _forces(arguments: argparse.Namespace, model: ReducedModel, tracked: Run | None) -> list[MeasuredForces]:
    from morph_dslam.extend.identification import FEWEST_FORCES, MeasuredForces
    from morph_dslam.extend.reports import load_curve, reaction_in_direction

    curves = [load_curve(path, model, column, FEWEST_FORCES) for path, column in arguments.force]
    files = [path.resolve() for path, _ in arguments.force]
    _check_once([(path, curve.name) for path, curve in zip(files, curves, strict=True)])
    names = _distinct([(path, curve.name) for (path, _), curve in zip(arguments.force, curves, strict=True)])
    return [
        MeasuredForces(
            model, replace(curve, name=name), reaction_in_direction(model, text), tracked, not arguments.no_offset
        )
        for curve, name, text in zip(curves, names, arguments.reaction, strict=True)
    ]


def _distinct(tables: Sequence[tuple[Path, str]]) -> list[str]:
    """Names of tables, of their files and own names: with the file where several have the same name."""
    names = [name for _, name in tables]
    files = [path.name for path, _ in tables]
    return [
        name if names.count(name) == 1 else f"{path.name if files.count(path.name) == 1 else path}:{name}"
        for path, name in tables
    ]


def _check_once(tables: Sequence[tuple[object, ...]]) -> None:
    """Refuse the same measurements twice: they would count as independent ones."""
    for i, table in enumerate(tables):
        if table in tables[:i]:
            raise IdentificationError(f"{':'.join(map(str, table))} is given twice: its values would count twice")
