"""`morph register`: an undeformed object in the map of a scene."""

import argparse
from pathlib import Path

from morph_dslam.cli.arguments import add_file, add_flag, add_output, add_repeated, positive_number, region

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
    from morph_dslam.extend.registration import registration_line, run_registration

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
    print(registration_line(registration))
