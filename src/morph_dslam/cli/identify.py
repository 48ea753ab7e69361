"""`morph identify`: parameters that are one for a whole recording, from points and forces."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from morph_dslam.cli.arguments import add_file, add_flag, add_output, add_repeated, file_and_column
from morph_dslam.errors import IdentificationError

if TYPE_CHECKING:
    from morph_dslam import ReducedModel

HELP = "find moduli and other constant parameters from measured points and forces"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "model", "model file of `morph build`", "MODEL")
    add_repeated(command, "--parameter", "a parameter of the model to identify", "NAME")
    add_flag(command, "--moduli", "identify a common factor of all moduli, from forces")
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
    command.add_argument(
        "--run",
        dest="run_folder",
        type=Path,
        metavar="RUN",
        help="run folder of the video: its frames, and its estimates of per-sequence parameters",
    )
    add_output(command, "OUT", "folder to write")


def run(arguments: argparse.Namespace) -> None:
    """Identify and print the estimates."""
    from morph_dslam import load_model, load_run
    from morph_dslam.extend.identification import (
        MeasuredForces,
        identification_lines,
        identify,
        last_line,
        load_points,
        write_identification,
    )
    from morph_dslam.extend.reports import load_curve, reaction_in_direction

    if len(arguments.reaction) != len(arguments.force):
        raise IdentificationError("give one --reaction SET:AXIS for each --force, in the same order")
    model = load_model(arguments.model)
    tracked = None if arguments.run_folder is None else load_run(arguments.run_folder)
    points = [load_points(path, model) for path in arguments.points]
    forces = [
        MeasuredForces(model, load_curve(path, model, column), reaction_in_direction(model, text), tracked)
        for (path, column), text in zip(arguments.force, arguments.reaction, strict=True)
    ]
    prior = {} if arguments.run_folder is None else _from_pictures(arguments.run_folder, model)
    found = identify(model, [*points, *forces], arguments.parameter, arguments.moduli, prior)
    figures = write_identification(arguments.output, found)
    for line in identification_lines(figures):
        print(line)
    by_frame = any(each.curve.against == "frame" for each in forces)
    if tracked is not None and not by_frame and not set(prior) & set(arguments.parameter):
        print(
            "note: --run changes nothing here: no forces are given by frame, and no parameter to identify is one that "
            "the run found for its whole sequence"
        )
    print(f"wrote {arguments.output / 'identification.json'} and identification.png")
    print(last_line(figures))


def _from_pictures(folder: Path, model: ReducedModel) -> dict[str, tuple[float, float]]:
    """Value and standard deviation, SI, of the per-sequence parameters of a run."""
    known = json.loads((folder / "summary.json").read_text())["one_over_the_sequence"]
    units = {parameter.name: parameter.display(1.0) for parameter in model.parameters}
    return {
        each["name"]: (each["value"] / units[each["name"]], each["standard_deviation"] / units[each["name"]])
        for each in known
        if each["name"] in units and each["observable"]
    }
