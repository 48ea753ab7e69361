"""The arguments that `morph track` and `morph live` share, in groups as `--help` shows them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from morph_dslam.cli.arguments import (
    add_depth_per_metre,
    add_file,
    add_flag,
    add_output,
    add_range,
    add_rate,
    add_repeated,
    frame_and_file,
    named_place,
    named_value,
    percentage,
    positive_number,
)

#: Kinds of streams, for the help.
STREAMS = "ws:PORT by WebSocket, rerun:FILE.rrd or ros2:/PREFIX"
_Group = argparse._ArgumentGroup


class Groups(NamedTuple):
    """The groups, in their order; a command adds its own arguments to them."""

    inputs: _Group
    start: _Group
    measured: _Group
    still: _Group
    forces: _Group
    output: _Group


def add_tracking_arguments(command: argparse.ArgumentParser, required: bool = True) -> Groups:
    """The arguments that say what is tracked, with what, and where it is at first; whether these must be named."""
    groups = Groups(
        command.add_argument_group("objects and frames"),
        command.add_argument_group(
            "where the object is", "By landmarks, a registration, a board, a picture or a guess: one of them."
        ),
        command.add_argument_group("what is measured"),
        command.add_argument_group("what stands still"),
        command.add_argument_group("forces and material"),
        command.add_argument_group("picture and output"),
    )
    _add_inputs(groups.inputs, required)
    _add_start(groups.start, required)
    _add_measured(groups.measured)
    _add_still(groups.still)
    _add_forces(groups.forces)
    _add_output(groups.output, required)
    return groups


def _add_inputs(group: _Group, required: bool) -> None:
    add_file(group, "--model", "model file of `morph build`", "MODEL", required)
    add_file(group, "--camera", "camera file: size, intrinsics, distortion", "CAMERA", required)
    add_range(group, "frames to track, of a recording")
    add_rate(group)
    group.add_argument(
        "--also",
        nargs=3,
        action="append",
        default=[],
        metavar=("NAME", "MODEL", "START"),
        help="another object in the same frames, its results in RUN/NAME; START is its registration.json in "
        "the same map or its file of landmarks; may be repeated",
    )
    add_repeated(group, "--inner", "a structure inside of the object (`morph inner`) to draw and report", "FILE", Path)


def _add_start(group: _Group, required: bool) -> None:
    start = group.add_mutually_exclusive_group(required=required)
    add_file(start, "--landmarks", "object points and their pixels in the reference frame", "LANDMARKS")
    add_file(start, "--registration", "registration.json of `morph register` in a map", "REGISTRATION")
    add_file(start, "--board", "a printed board of markers, and where the object is on it", "BOARD")
    add_file(start, "--picture", "a picture of the object's print, and where it is on it", "PICTURE")
    add_file(start, "--guess", "about where the object is in the reference frame", "GUESS")
    add_flag(group, "--snap", "correct the landmarks by the object's outline in their frame")
    add_file(
        group,
        "--map",
        "with --registration: the map that the camera is found in (default: the one that was registered in)",
        "MAP",
    )
    add_repeated(
        group,
        "--reregister-at",
        "register the object, or that of --also NAME, anew in frame N, by landmarks there or by the board, "
        "picture or guess that the run starts from",
        "[NAME:]N[=FILE]",
        frame_and_file,
    )


def _add_measured(group: _Group) -> None:
    add_flag(group, "--outline", "let the object's outline count too, where it stands out from the background")
    add_flag(group, "--no-texture", "follow the object by its outline alone")
    add_flag(group, "--depth", "let the depth images of an RGB-D recording count too")
    add_depth_per_metre(group)
    add_flag(
        group,
        "--one-view",
        "take one keyframe of the map as reference view, and make none when the object turns other parts to the camera",
    )
    add_flag(
        group,
        "--discrepancy",
        "look for what the object's shape has beyond the model's: small smooth displacements that hardly stretch it",
    )
    group.add_argument(
        "--time-zero",
        type=float,
        metavar="SECONDS",
        help="time of the recording, as in frames.csv, at which the model's time begins: its parameter of time is then "
        "known in every frame (default: it is unknown like others)",
    )
    add_repeated(
        group,
        "--random-walk",
        "a prior on a parameter: the standard deviation of its change from frame to frame, in its own "
        "unit (default: none)",
        "NAME=STEP",
        named_value,
    )
    group.add_argument(
        "--start",
        choices=("previous", "constant-velocity"),
        default="previous",
        help="where the search for a frame's state starts (default: %(default)s state)",
    )


def _add_still(group: _Group) -> None:
    pose = group.add_mutually_exclusive_group()
    pose.add_argument(
        "--pose",
        choices=("map", "fixed", "free"),
        default="map",
        help="the object's pose with --registration: by map and points together, by the map alone, or by its points "
        "alone (default: %(default)s)",
    )
    pose.add_argument(
        "--still",
        dest="pose",
        action="store_const",
        const="still",
        help="camera and support stand still: one pose for the whole sequence, estimated from all frames",
    )
    add_flag(group, "--at-rest", "the object is undeformed in the frame of its landmarks")
    add_repeated(group, "--per-sequence", "a per-sequence parameter: it has one value in the whole sequence", "NAME")


def _add_forces(group: _Group) -> None:
    group.add_argument(
        "--unknown-loads",
        nargs="?",
        type=positive_number,
        const=0.0,
        metavar="JOULES",
        help="estimate loads that the study does not foresee, by [unknown_loads] of its model: what presses or pulls "
        "and how hard; likely ones do about this work (default: found from the sequence)",
    )
    add_flag(group, "--forces", "draw what supports exert on the object as arrows, with its size")
    group.add_argument(
        "--modulus-std",
        type=percentage,
        default=0.0,
        metavar="PERCENT",
        help="standard deviation of the moduli of the study, by one common factor: it counts in the reactions of "
        "supports (default: they are exact)",
    )


def _add_output(group: _Group, required: bool) -> None:
    add_output(group, "RUN", "run folder to write", required)
    add_flag(
        group,
        "--overwrite",
        "replace a run that is in the run folder, and an earlier frame log or recording of a stream",
    )
    add_repeated(
        group,
        "--point",
        "write and plot the displacement of the undeformed object's point X,Y,Z, in millimetres",
        "NAME=X,Y,Z",
        named_place,
    )
    group.add_argument(
        "--show",
        choices=("stress", "strain", "displacement", "traction"),
        help="what colours the object: von Mises stress (the default), equivalent strain, displacement, or the "
        "traction of unknown loads",
    )
    group.add_argument(
        "--section",
        metavar="PLANE",
        help="draw a solid cut open: x=12 takes away all beyond x = 12 mm, -x=12 all before it; also y and z",
    )
    add_flag(group, "--no-video", "do not draw the augmented video")
    add_repeated(
        group,
        "--stream",
        "send results to other programs as they come, " + STREAMS + " (docs/streams.md)",
        "KIND[:WHERE]",
    )
    add_file(
        group,
        "--frame-log",
        "write a line of JSON for each frame as soon as it is tracked (docs/run-folder.md)",
        "FILE",
    )
