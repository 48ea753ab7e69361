"""`morph register`: an undeformed object in the map of a scene."""

from __future__ import annotations

import argparse
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

from morph_dslam.cli.arguments import add_file, add_flag, add_output, add_repeated, positive_number, region

if TYPE_CHECKING:
    from morph_dslam import Registration

HELP = "find an undeformed object in the map of a scene, and the size of the map's unit"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "map", "map.h5 of a run of `morph slam`")
    add_file(command, "--model", "model file of the object", required=True)
    add_file(command, "--camera", "camera file of the map", required=True)
    add_output(command, "FOLDER", "folder to write")
    add_file(
        command, "--board", "register the object, and find the map's unit, by a board that stands in the scene", "TOML"
    )
    add_file(command, "--landmarks", "points of the object clicked in frames of the scan, three or more in one", "CSV")
    command.add_argument(
        "--distance",
        type=positive_number,
        metavar="METRES",
        help="rough distance of the object from the camera in the scan; it may be off by half",
    )
    command.add_argument(
        "--region", type=region, metavar="N:LEFT,TOP,RIGHT,BOTTOM", help="box around the object in keyframe N, pixels"
    )
    add_file(command, "--guess", "about where the object is in a frame of the scan", "TOML")
    add_repeated(
        command,
        "--beside",
        "registration.json of another object in this map, to which its points are left",
        "JSON",
        Path,
    )
    add_flag(command, "--overwrite", "replace a registration that is in the folder")


def run(arguments: argparse.Namespace) -> None:
    """Register the object and print how well it fits."""
    from morph_dslam.extend.registration import run_registration

    registration = run_registration(
        arguments.map,
        arguments.model,
        arguments.camera,
        arguments.output,
        arguments.beside,
        arguments.board,
        landmarks=arguments.landmarks,
        distance=arguments.distance,
        region=arguments.region,
        guess=arguments.guess,
        overwrite=arguments.overwrite,
    )
    assert registration.scene is not None
    for note in [*(warning.text for warning in registration.warnings), *registration.scene.camera_notes]:
        print(f"note: {note}")
    picture = "" if arguments.board else " and registration.jpg"
    print(f"wrote {arguments.output / 'registration.json'}{picture}")
    print(_line(registration))


def _line(registration: Registration) -> str:
    """The size of the map's unit, and how well the place is known.

    Scores are left out: those of two searches, with hints and without, measure different things.
    """
    facts, deviations = registration.facts, registration.pose_deviations()
    agreement = "none" if facts["rms_px"] is None else f"{facts['rms_px']:.3f}"
    place, angle = (
        ("unknown",) * 2 if deviations is None else (f"{1e3 * deviations[0]:.2f}", f"{degrees(deviations[1]):.2f}")
    )
    return (
        f"map_units_per_metre={facts['map_units_per_metre']:.6g} rms_px={agreement} place_std_mm={place} "
        f"angle_std_deg={angle} ambiguous={'yes' if registration.ambiguous else 'no'}"
    )
