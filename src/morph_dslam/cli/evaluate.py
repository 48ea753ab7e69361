"""`morph evaluate`: a run against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from morph_dslam.errors import EvaluationError

HELP = "compare a run with measured points or depth images, or its camera path with the true one"
KEPT = "the run is unchanged"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("run_folder", type=Path, metavar="RUN", help="run folder, or a trajectory file")
    truth = command.add_mutually_exclusive_group(required=True)
    truth.add_argument("--points", type=Path, metavar="TRUTH", help="truth file, .npz (docs/run-folder.md)")
    truth.add_argument(
        "--trajectory", type=Path, metavar="TRUTH", help="true camera path (TUM, KITTI, COLMAP or 7-Scenes)"
    )
    truth.add_argument(
        "--depth",
        type=Path,
        metavar="DEPTH",
        help="depth.h5 of a simulation, a recording with depth, or a folder of 16-bit images",
    )
    command.add_argument(
        "--base-frame", type=int, metavar="N", help="with --depth: a frame in which nothing is deformed"
    )
    command.add_argument(
        "--depth-per-metre", type=float, metavar="V", help="with a folder of depth images: values a metre"
    )
    command.add_argument(
        "--bind-frame",
        type=int,
        metavar="N",
        help="with --points: frame whose pixels bind the truth points to the mesh",
    )


def run(arguments: argparse.Namespace) -> None:
    """Compare and print the figures."""
    _check(arguments)
    if arguments.trajectory is not None:
        from morph_dslam.evaluation.trajectory import evaluate_trajectory, trajectory_line

        print(trajectory_line(evaluate_trajectory(arguments.run_folder, arguments.trajectory)))
    elif arguments.depth is not None:
        _by_depth(arguments)
    else:
        _by_points(arguments)


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that would have no effect."""
    if arguments.depth is None and (arguments.base_frame, arguments.depth_per_metre) != (None, None):
        raise EvaluationError("--base-frame and --depth-per-metre go with --depth: leave them out")
    if arguments.points is None and arguments.bind_frame is not None:
        raise EvaluationError("--bind-frame goes with --points: leave it out")
    if arguments.points is not None and arguments.bind_frame is None:
        raise EvaluationError("--points needs --bind-frame N, the frame whose pixels bind the points to the mesh")


def _by_depth(arguments: argparse.Namespace) -> None:
    from morph_dslam.evaluation.evaluate import evaluate_depth
    from morph_dslam.evaluation.run_folder import depth_line

    folder = arguments.run_folder
    found = evaluate_depth(folder, arguments.depth, arguments.base_frame, arguments.depth_per_metre)
    print(f"wrote {folder / 'depth_evaluation.json'} and depth_evaluation.png")
    print(depth_line(found))


def _by_points(arguments: argparse.Namespace) -> None:
    from morph_dslam.evaluation.evaluate import evaluate
    from morph_dslam.evaluation.run_folder import alignment_line, remarks, result_line

    figures = evaluate(arguments.run_folder, arguments.points, arguments.bind_frame)
    for remark in remarks(figures):
        print(f"note: {remark}")
    print(f"wrote {arguments.run_folder / 'evaluation.json'} and {arguments.run_folder / 'report.html'}")
    print(alignment_line(figures))
    print(result_line(figures))
