"""`morph track`, and what `morph live` does as it does: an object's pose and parameters in every frame."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morph_dslam.cli.arguments import add_file, add_flag, add_repeated
from morph_dslam.cli.interruption import interrupt_behind
from morph_dslam.cli.tracking_arguments import add_tracking_arguments
from morph_dslam.errors import TrackingError

if TYPE_CHECKING:
    from morph_dslam import TrackerOptions, TrackOptions
    from morph_dslam.extend.tracking import FoundInputs, ObjectOptions

HELP = "find an object's pose and parameters in every frame, and draw the stress over the video"
#: Options that say where the object is.
_STARTS = ("landmarks", "registration", "board", "picture", "guess")
#: A relative error below this is one of rounding.
ROUNDING = 1e-9
KEPT = "the frames tracked so far are kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(
        command,
        "frames",
        "video file, folder of numbered images, or another recording (docs/sources.md); or a folder that holds one and "
        "what is not named: model or study, camera, and where the object is",
        "FRAMES",
    )
    groups = add_tracking_arguments(command, required=False)
    add_repeated(
        groups.inputs,
        "--with",
        "what the next camera of the rig saw; with --camera camchain.yaml#cam0, which a map is of too",
        "FRAMES",
        Path,
    )
    add_repeated(
        groups.start,
        "--with-landmarks",
        "landmarks in what the next camera of the rig saw in the reference frame, in the order of --with",
        "LANDMARKS",
        Path,
    )
    groups.start.add_argument(
        "--reference-frame",
        type=int,
        metavar="N",
        help="frame that the landmarks, or another start, belong to (default: the first one tracked); with "
        "--registration and --with: one in which the object is undeformed",
    )
    groups.measured.add_argument(
        "--known",
        type=Path,
        metavar="CSV",
        help="parameters that something else measured, by frame: columns frame, pressure_kPa and perhaps "
        "pressure_std_kPa (default deviation: half a percent of the range)",
    )
    add_flag(
        groups.measured,
        "--refine",
        "refine the reference state over the whole sequence, with --discrepancy that too, and track once more; --still "
        "does that with the pose already",
    )
    groups.still.add_argument(
        "--refine-camera",
        action="append",
        default=[],
        choices=("focal", "radial"),
        help="with --still: estimate the focal length, or one radial term of the lens, over the recording too; may be "
        "repeated",
    )


def run(arguments: argparse.Namespace) -> None:
    """Track and print the figures of each run folder."""
    _complete(arguments)
    options = run_options(
        arguments,
        frames=arguments.frames,
        reference_frame=arguments.reference_frame,
        refine_reference=arguments.refine,
        refine_camera=tuple(dict.fromkeys(arguments.refine_camera)),
        other_cameras=tuple(vars(arguments)["with"]),  # a keyword of the language
        other_landmarks=tuple(arguments.with_landmarks),
    )
    if options.refine_reference and options.tracker.pose == "still":
        print(
            "note: --refine changes nothing here: --still estimates the reference pose over the whole sequence already"
        )
    track_and_print(options)


def track_and_print(options: TrackOptions) -> None:
    """Track, and print the figures of each run folder; where nothing was tracked, no empty folder is left behind.

    Raises
    ------
    MorphError
        As `track`; TrackingError if each object was lost in all frames, once the run folders are complete.
    """
    from morph_dslam import track

    absent = [folder for folder in options.folders if not folder.exists()]
    written: dict[Path, dict[str, Any]] = {}

    def tell(folder: Path, summary: dict[str, Any]) -> None:
        if summary:
            written[folder] = summary
        print_summary(folder, summary)

    try:
        track(options, tell)
    except (KeyboardInterrupt, SystemError) as error:
        if written or interrupt_behind(error) is None:
            raise
        raise KeyboardInterrupt("nothing was tracked yet") from None
    finally:
        for folder in reversed(absent):
            with suppress(OSError):  # it was not made, or holds something
                folder.rmdir()
    if written and all(summary["n_lost"] == summary["n_frames"] for summary in written.values()):
        reasons = " and ".join(str(folder / "frames.csv") for folder in written)
        raise TrackingError(
            f"the object was lost in every frame, for the reasons in {reasons}: check where it starts, the camera "
            "file, and that the recording shows it"
        )


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
    before = ["", *arguments.words]  # the folder of the results may be the same one
    words = [
        str(arguments.frames) if Path(word) == folder and option not in ("-o", "--output") else word
        for option, word in zip(before, arguments.words, strict=False)
    ]
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
        line = "largest force, {on}: {force_N:.4g} ± {standard_deviation_N:.2g} N in frame {frame}"
        if not figures["differs_from_zero"]:
            line = (
                "largest force, {on}: no frame tells a force apart from zero; the largest is {force_N:.3g} ± "
                "{standard_deviation_N:.3g} N in frame {frame}"
            )
        print(line.format(**figures) + _beyond_range(figures["at_bound"]) + _not_counted(figures))
    for figures in summary.get("points", []):
        if "frame" in figures:
            line = "largest displacement of '{name}': {displacement_mm:.4g} ± {standard_deviation_mm:.2g} mm in frame "
            print((line + "{frame}").format(**figures) + _not_counted(figures))
            line = (
                "largest rotation of '{name}': {rotation_deg:.4g} ± {rotation_standard_deviation_deg:.2g} degrees in "
            )
            print((line + "frame {rotation_frame}").format(**figures) + _not_counted(figures))
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


def _beyond_range(names: Sequence[str]) -> str:
    """What parameters at an end of their range mean for the force of that frame."""
    if not names:
        return ""
    ends = "an end of its range" if len(names) == 1 else "ends of their ranges"
    said = " and ".join(f"'{name}'" for name in names)
    return f", with {said} at {ends}: the object may be beyond, and the force another"


def _not_counted(figures: dict[str, Any]) -> str:
    """What the deviation of a force or of a point does not contain; it has what the mesh does to parameters."""
    parts: list[str] = []
    if "model_error" in figures:
        of = "error" if figures["model_error_of"] == "all" else "reduction error"
        share = figures["model_error"]
        if share > ROUNDING:
            parts.append(f"the model's own {of} at given parameters, {100.0 * share:.3g} %")
    if figures["not_counted"]:
        *some, last = figures["not_counted"]
        parts.append(f"errors of the model's {' and '.join([', '.join(some), last] if some else [last])}")
    return f", not counting {', and '.join(parts)}" if parts else ""


def run_options(arguments: argparse.Namespace, **more: Any) -> TrackOptions:
    """What `add_tracking_arguments` asked for, and more.

    What names parameters, structures, points, moduli or the time of a model is of the first object's, and holds for
    that only; so does what says that it has no texture. All else holds for every object: what is at rest, or snapped
    to its outline, for those that start by landmarks.
    """
    from morph_dslam import TrackerOptions, TrackOptions
    from morph_dslam.extend.registration import InitializerFiles
    from morph_dslam.extend.tracking import DrawOptions, EstimationOptions, LoadOptions, SectionPlane

    tracker = TrackerOptions(
        pose=arguments.pose,
        use_depth=arguments.depth,
        use_discrepancy=arguments.discrepancy,
        use_unknown_loads=arguments.unknown_loads is not None,
        estimation=EstimationOptions(loads=LoadOptions(work=arguments.unknown_loads or None)),
        use_outline=arguments.outline,
        start=arguments.start,
        new_views=not arguments.one_view,
        further_views=not arguments.one_view,
    )
    others = _other_objects(arguments, tracker)
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
        points=tuple(arguments.point),
        known=getattr(arguments, "known", None),
        time_zero=arguments.time_zero,
        reregister_at=_reregistered_at(arguments, ""),
        tracker=replace(
            tracker,
            use_texture=not arguments.no_texture,
            per_sequence=tuple(arguments.per_sequence),
            random_walk=_random_walk(arguments),
            modulus_std=0.01 * arguments.modulus_std,
        ),
        others=others,
        first=first,
        last=last,
        fps=arguments.fps,
        depth_per_metre=arguments.depth_per_metre,
        output=arguments.output,
        overwrite=arguments.overwrite,
        video=not arguments.no_video,
        streams=tuple(arguments.stream),
        frame_log=arguments.frame_log,
        drawing=DrawOptions(arguments.show, section, arguments.forces),
        **more,
    )


def _other_objects(arguments: argparse.Namespace, tracker: TrackerOptions) -> tuple[tuple[str, ObjectOptions], ...]:
    """Names and options of the objects of ``--also``, tracked as the first one is.

    Raises
    ------
    TrackingError
        If one that is not among them is to be registered anew.
    """
    from morph_dslam.extend.tracking import ObjectOptions

    others = []
    for name, model, start in arguments.also:
        is_registered = start.endswith(".json")
        is_free = not is_registered and tracker.pose != "still"
        part = ObjectOptions(
            model=Path(model),
            landmarks=None if is_registered else Path(start),
            registration=Path(start) if is_registered else None,
            at_rest=arguments.at_rest and not is_registered,
            snap=arguments.snap and not is_registered,
            reregister_at=_reregistered_at(arguments, name),
            tracker=replace(tracker, pose="map") if is_free else tracker,
        )
        others.append((name, part))
    unknown = {of for of, _, _ in arguments.reregister_at} - {"", *(name for name, _ in others)}
    if unknown:
        raise TrackingError(f"--reregister-at {min(unknown)}: there is no --also of that name")
    return tuple(others)


def _reregistered_at(arguments: argparse.Namespace, name: str) -> tuple[tuple[int, Path | None], ...]:
    """Frames in which an object is registered anew, and by which landmarks; "" is the first object."""
    return tuple((frame, path) for of, frame, path in arguments.reregister_at if of == name)


def _random_walk(arguments: argparse.Namespace) -> tuple[tuple[str, float], ...]:
    """Steps in SI of parameters that walk; of a name that is none it stays as it is, to be refused later."""
    if not arguments.random_walk:
        return ()
    from morph_dslam import load_model

    units = {parameter.name: parameter.display(1.0) for parameter in load_model(arguments.model).parameters}
    return tuple((name, step / units.get(name, 1.0)) for name, step in arguments.random_walk)
