"""`morph evaluate`: a run against the truth."""

import argparse

from morph_dslam.cli.arguments import add_file, file_and_column
from morph_dslam.errors import EvaluationError

HELP = "compare a run with measured points, tracks in images, depth or forces, or its camera path with the true one"
KEPT = "the run is unchanged"


def add_arguments(command: argparse.ArgumentParser) -> None:
    written = "the figures are written into it, those of FILE.txt beside it as FILE_evaluation.json and .png"
    add_file(command, "run_folder", f"run folder, or a trajectory file; {written}", "RUN")
    truth = command.add_mutually_exclusive_group(required=True)
    add_file(truth, "--points", "truth file, .npz (docs/evaluation.md)", "TRUTH")
    add_file(truth, "--pixels", "points followed in the images, CSV with frame,id,u,v", "TRACKS")
    truth.add_argument(
        "--force",
        type=file_and_column,
        metavar="CURVE[:COLUMN]",
        help="measured forces, CSV by frame or by a parameter such as stroke_mm",
    )
    add_file(truth, "--trajectory", "true camera path (TUM, KITTI, COLMAP, EuRoC or 7-Scenes)", "TRUTH")
    add_file(
        truth, "--depth", "depth.h5 of a simulation, a recording with depth, or a folder of 16-bit images", "DEPTH"
    )
    command.add_argument(
        "--base-frame", type=int, metavar="N", help="with --depth: a frame in which nothing is deformed"
    )
    command.add_argument(
        "--depth-per-metre", type=float, metavar="VALUES", help="with --depth: values a metre of the images"
    )
    command.add_argument(
        "--bind-frame",
        type=int,
        metavar="N",
        help="with --points and --pixels: frame whose pixels bind the points to the mesh (default: the first one that "
        "was tracked and measured)",
    )
    command.add_argument(
        "--reaction", metavar="SET[:AXIS]", help="with --force: the support, and x, +x, -x, y ... of the object frame"
    )


def run(arguments: argparse.Namespace) -> None:
    """Compare and print the figures."""
    from morph_dslam import evaluate, evaluate_depth, evaluate_trajectory
    from morph_dslam.extend.reports import (
        alignment_line,
        depth_line,
        evaluate_force,
        evaluate_pixels,
        force_line,
        force_remarks,
        pixel_line,
        pixel_remarks,
        remarks,
        result_line,
        trajectory_evaluation_files,
        trajectory_line,
    )

    _check(arguments)
    folder = arguments.run_folder
    if arguments.trajectory is not None:
        figures = evaluate_trajectory(folder, arguments.trajectory)
        content, picture = trajectory_evaluation_files(folder)
        print(f"wrote {content} and {picture.name}")
        print(trajectory_line(figures))
    elif arguments.depth is not None:
        found = evaluate_depth(folder, arguments.depth, arguments.base_frame, arguments.depth_per_metre)
        print(f"wrote {folder / 'depth_evaluation.json'} and depth_evaluation.png")
        print(depth_line(found))
    elif arguments.pixels is not None:
        figures = evaluate_pixels(folder, arguments.pixels, arguments.bind_frame)
        _print_notes(pixel_remarks(figures))
        print(f"wrote {folder / 'pixel_evaluation.json'} and {folder / 'report.html'}")
        print(pixel_line(figures))
    elif arguments.force is not None:
        curve, column = arguments.force
        figures = evaluate_force(folder, curve, column, arguments.reaction)
        _print_notes(force_remarks(figures))
        print(f"wrote {folder / 'force_evaluation.json'} and {folder / 'report.html'}")
        print(force_line(figures))
    else:
        figures = evaluate(folder, arguments.points, arguments.bind_frame)
        if arguments.bind_frame is None:
            frame = figures["bind_frame"]
            print(f"note: points are bound in frame {frame}; if another shows more of them, name it by --bind-frame")
        _print_notes(remarks(figures))
        print(f"wrote {folder / 'evaluation.json'} and {folder / 'report.html'}")
        print(alignment_line(figures))
        print(result_line(figures))


def _print_notes(lines: list[str]) -> None:
    for line in lines:
        print(f"note: {line}")


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that would have no effect."""
    if arguments.depth is None and (arguments.base_frame, arguments.depth_per_metre) != (None, None):
        raise EvaluationError("--base-frame and --depth-per-metre go with --depth: leave them out")
    if arguments.points is None and arguments.pixels is None and arguments.bind_frame is not None:
        raise EvaluationError("--bind-frame goes with --points and --pixels: leave it out")
    if arguments.force is None and arguments.reaction is not None:
        raise EvaluationError("--reaction goes with --force: leave it out")
