"""`morph track`, and what `morph live` shares with it: an object's pose and parameters in every frame."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morph_dslam.cli.arguments import (
    add_file,
    add_flag,
    add_output,
    add_range,
    add_repeated,
    frame_and_file,
    named_value,
    positive_number,
)
from morph_dslam.errors import TrackingError

if TYPE_CHECKING:
    from morph_dslam import TrackOptions
    from morph_dslam.extend.tracking import FoundInputs

HELP = "find an object's pose and parameters in every frame, and draw the stress over the video"
#: Options that say where the object is.
_STARTS = ("landmarks", "registration", "board", "picture", "guess")
#: Kinds of streams, for the help.
STREAMS = "ws:PORT by WebSocket, rerun:FILE.rrd or ros2:/PREFIX"
KEPT = "the frames tracked so far are kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(
        command,
        "frames",
        "video file, folder of numbered images, or another recording (docs/sources.md); or a folder that holds one and "
        "what is not named: model or study, camera, and where the object is",
        "FRAMES",
    )
    add_tracking_arguments(command, required=False)
    command.add_argument(
        "--reference-frame",
        type=int,
        metavar="N",
        help="frame that the landmarks, or another start, belong to (default: the first one tracked); with "
        "--registration and --with: one in which the object is undeformed",
    )
    command.add_argument(
        "--refine-camera",
        action="append",
        default=[],
        choices=("focal", "radial"),
        help="with --still: estimate the focal length, or one radial term of the lens, over the recording too; may be "
        "repeated",
    )
    add_flag(command, "--refine", "refine the reference state over the whole sequence and track once more")
    add_repeated(
        command,
        "--with",
        "what the next camera of the rig saw; with --camera camchain.yaml#cam0, which a map is of too",
        "FRAMES",
        Path,
    )


def run(arguments: argparse.Namespace) -> None:
    """Track and print the figures of each run folder."""
    from morph_dslam import track

    _complete(arguments)
    options = run_options(
        arguments,
        frames=arguments.frames,
        reference_frame=arguments.reference_frame,
        refine_reference=arguments.refine,
        refine_camera=tuple(dict.fromkeys(arguments.refine_camera)),
        other_cameras=tuple(vars(arguments)["with"]),  # a keyword of the language
    )
    track(options, print_summary)


def _complete(arguments: argparse.Namespace) -> None:
    """Find in the folder ``arguments.frames`` what is not named, and print the command with it.

    A model that is not there is built from the study that is.
    """
    from morph_dslam.extend.tracking import find_inputs

    missing = [name for name in ("model", "camera", "output") if getattr(arguments, name) is None]
    starts = [name for name in _STARTS if getattr(arguments, name) is not None]
    if not missing and starts:
        return
    folder = arguments.frames
    if not folder.is_dir():
        named = [f"--{name}" for name in missing] + ([] if starts else ["--landmarks or another start"])
        raise TrackingError(f"name {', '.join(named)} too, or give a folder that holds all inputs in place of {folder}")
    found = find_inputs(folder)
    if not starts:
        missing.insert(2, found.start[0])
        setattr(arguments, *found.start)
    arguments.frames, arguments.camera = found.recording, arguments.camera or found.camera
    arguments.model = arguments.model or _found_model(found)
    arguments.output = arguments.output or folder / "run"
    words = [str(arguments.frames) if Path(word) == folder else word for word in arguments.words]
    named = [(f"--{name}", str(getattr(arguments, name))) for name in missing]
    print(shlex.join(["morph", *words, *chain(*named)]))


def _found_model(found: FoundInputs) -> Path:
    """The model in a folder, built first if there is only its study."""
    if found.models or len(found.studies) != 1:
        for study in found.studies:
            if study.stat().st_mtime > found.model.stat().st_mtime:
                print(f"note: {study} is newer than {found.model}: if it was changed, build the model again")
        return found.model
    from morph_dslam.cli.build import build_study

    study, model = found.studies[0], found.studies[0].with_suffix(".morph")
    print(shlex.join(["morph", "build", str(study), "-o", str(model)]))
    build_study(study, model)
    return model


def print_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Print what came of a run, recorded or live; without a summary no frame was tracked."""
    from morph_dslam.extend.reports import value_line

    if not summary:
        print("no frame was tracked: nothing was written")
        return
    for flag in summary["flags"]:
        print(f"note: {flag}")
    for figures in summary["one_over_the_sequence"]:
        print(value_line(figures))
    for figures in summary["largest_forces"]:
        print("largest force, {on}: {force_N:.4g} ± {standard_deviation_N:.2g} N in frame {frame}".format(**figures))
    print(f"wrote {folder}")
    line = f"tracked={summary['n_tracked']}/{summary['n_frames']}"
    if "live" in summary:
        figures = summary["live"]
        line += f" fps={figures['fps']:.1f} dropped={figures['n_dropped']}"
        line += f" latency_median_ms={figures['latency_median_ms']:.1f} latency_p95_ms={figures['latency_p95_ms']:.1f}"
    else:
        line += f" median_ms={summary['median_ms']:.2f} p95_ms={summary['p95_ms']:.2f}"
    # Of a live stream, frames that are skipped are those that were dropped.
    kinds = ("hidden", "lost") if "live" in summary else ("hidden", "lost", "skipped")
    print(line + "".join(f" {kind}={summary[f'n_{kind}']}" for kind in kinds if summary[f"n_{kind}"]))


def run_options(arguments: argparse.Namespace, **more: Any) -> TrackOptions:
    """What `add_tracking_arguments` asked for, and more.

    What is asked for of parameters, the outline and inner structures holds for the first object only.
    """
    from morph_dslam import TrackerOptions, TrackOptions
    from morph_dslam.extend.registration import InitializerFiles
    from morph_dslam.extend.tracking import DrawOptions, EstimationOptions, LoadOptions, ObjectOptions, SectionPlane

    tracker = TrackerOptions(
        pose=arguments.pose,
        use_depth=arguments.depth,
        use_discrepancy=arguments.discrepancy,
        use_unknown_loads=arguments.unknown_loads is not None,
        estimation=EstimationOptions(loads=LoadOptions(work=arguments.unknown_loads or None)),
        start=arguments.start,
        new_views=not arguments.one_view,
        further_views=not arguments.one_view,
    )

    def frames_of(name: str) -> tuple[tuple[int, Path | None], ...]:
        return tuple((frame, path) for of, frame, path in arguments.reregister_at if of == name)

    others = []
    for name, model, start in arguments.also:
        is_registered = start.endswith(".json")
        part = ObjectOptions(
            model=Path(model),
            landmarks=None if is_registered else Path(start),
            registration=Path(start) if is_registered else None,
            reregister_at=frames_of(name),
            tracker=tracker if is_registered else replace(tracker, pose="map"),
        )
        others.append((name, part))
    unknown = {of for of, _, _ in arguments.reregister_at} - {"", *(name for name, _ in others)}
    if unknown:
        raise TrackingError(f"--reregister-at {min(unknown)}: there is no --also of that name")
    first, last = arguments.range
    section = None if arguments.section is None else SectionPlane.parse(arguments.section)
    return TrackOptions(
        model=arguments.model,
        camera=arguments.camera,
        landmarks=arguments.landmarks,
        registration=arguments.registration,
        at_rest=arguments.at_rest,
        snap=arguments.snap,
        initializer=InitializerFiles(arguments.board, arguments.picture, arguments.guess),
        map_path=arguments.map,
        inner=tuple(arguments.inner),
        reregister_at=frames_of(""),
        tracker=replace(
            tracker,
            use_outline=arguments.outline or arguments.no_texture,
            use_texture=not arguments.no_texture,
            per_sequence=tuple(arguments.per_sequence),
            random_walk=_random_walk(arguments),
            modulus_std=0.01 * arguments.modulus_std,
        ),
        others=tuple(others),
        first=first,
        last=last,
        output=arguments.output,
        overwrite=arguments.overwrite,
        video=not arguments.no_video,
        streams=tuple(arguments.stream),
        frame_log=arguments.frame_log,
        drawing=DrawOptions(arguments.show, section, arguments.forces),
        **more,
    )


def _random_walk(arguments: argparse.Namespace) -> tuple[tuple[str, float], ...]:
    """Steps in SI of parameters that walk; of a name that is none it stays as it is, to be refused later."""
    if not arguments.random_walk:
        return ()
    from morph_dslam import load_model

    units = {parameter.name: parameter.display(1.0) for parameter in load_model(arguments.model).parameters}
    return tuple((name, step / units.get(name, 1.0)) for name, step in arguments.random_walk)


def add_tracking_arguments(command: argparse.ArgumentParser, required: bool = True) -> None:
    """The arguments that say what is tracked, with what, and where it is at first; whether these must be named."""
    add_file(command, "--model", "model file of `morph build`", required=required)
    add_file(command, "--camera", "camera file: size, intrinsics, distortion", required=required)
    start = command.add_mutually_exclusive_group(required=required)
    add_file(start, "--landmarks", "object points and their pixels in the reference frame")
    add_flag(command, "--at-rest", "the object is undeformed in the frame of its landmarks")
    add_flag(command, "--snap", "correct the landmarks by the object's outline in their frame")
    add_file(start, "--registration", "registration.json of `morph register` in a map", "JSON")
    add_file(start, "--board", "a printed board of markers, and where the object is on it", "TOML")
    add_file(start, "--picture", "a picture of the object's print, and where it is on it", "TOML")
    add_file(start, "--guess", "about where the object is in the reference frame", "TOML")
    add_file(
        command,
        "--map",
        "with --registration: the map that the camera is found in (default: the one that was registered in)",
        "H5",
    )
    pose = command.add_mutually_exclusive_group()
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
        help="camera and support stand still: the pose is one over the sequence, estimated from all frames",
    )
    add_output(command, "RUN", "run folder to write", required)
    add_flag(command, "--overwrite", "replace a run that is in the run folder")
    add_flag(command, "--outline", "let the object's outline count too, where it stands out from the background")
    add_flag(command, "--no-texture", "follow the object by its outline alone")
    add_flag(
        command,
        "--discrepancy",
        "look for what the object's shape has beyond the model's: small smooth displacements that "
        "hardly stretch it; with --refine in the reference view too",
    )
    command.add_argument(
        "--unknown-loads",
        nargs="?",
        type=float,
        const=0.0,
        metavar="JOULES",
        help="estimate loads that the study does not foresee, by [unknown_loads] of its model: what presses or pulls "
        "and how hard; likely ones do about this work (default: found from the sequence)",
    )
    add_flag(
        command,
        "--one-view",
        "take one keyframe of the map as reference view, and make none when the object turns other parts to the camera",
    )
    add_flag(command, "--depth", "let the depth images of an RGB-D recording count too")
    add_repeated(
        command, "--inner", "a structure inside of the object (`morph inner`) to draw and report", "FILE", Path
    )
    add_repeated(command, "--per-sequence", "a parameter that is one over the whole sequence", "NAME")
    add_repeated(
        command,
        "--random-walk",
        "a prior on a parameter: the standard deviation of its change from frame to frame, in its own "
        "unit (default: none)",
        "NAME=STEP",
        named_value,
    )
    command.add_argument(
        "--start",
        choices=("previous", "constant-velocity"),
        default="previous",
        help="where the search for a frame's state starts (default: %(default)s state)",
    )
    add_repeated(
        command,
        "--reregister-at",
        "register the object, or that of --also NAME, anew in frame N, by landmarks there or by the board, "
        "picture or guess that the run starts from",
        "[NAME:]N[=FILE]",
        frame_and_file,
    )
    command.add_argument(
        "--also",
        nargs=3,
        action="append",
        default=[],
        metavar=("NAME", "MODEL", "START"),
        help="another object in the same frames, its results in RUN/NAME; START is its registration.json in "
        "the same map or its file of landmarks; may be repeated",
    )
    command.add_argument(
        "--show",
        choices=("stress", "strain", "displacement", "traction"),
        help="what colours the object: von Mises stress (the default), equivalent strain, displacement, or the "
        "traction of unknown loads",
    )
    command.add_argument(
        "--section",
        metavar="PLANE",
        help="draw a solid cut open: x=12 takes away all beyond x = 12 mm, -x=12 all before it; also y and z",
    )
    add_flag(command, "--forces", "draw what supports exert on the object as arrows, with its size")
    command.add_argument(
        "--modulus-std",
        type=positive_number,
        default=0.0,
        metavar="PERCENT",
        help="standard deviation of the moduli of the study, by one common factor: it counts in the reactions of "
        "supports (default: they are exact)",
    )
    add_range(command, "frames to track, of a recording")
    add_flag(command, "--no-video", "do not draw the augmented video")
    add_repeated(
        command,
        "--stream",
        "send results to other programs as they come, " + STREAMS + " (docs/streams.md)",
        "KIND[:WHERE]",
    )
    add_file(
        command,
        "--frame-log",
        "write a line of JSON for each frame as soon as it is tracked (docs/run-folder.md)",
        "FILE",
    )
