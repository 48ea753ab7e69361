"""The command line: `morph build | info | export | explore | track | slam | register | evaluate | ...`.

Each command imports what it needs when it runs, so that `morph --help` answers at once.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

from morph_dslam._version import __version__
from morph_dslam.cli.arguments import positive_integer, with_signed_sections
from morph_dslam.cli.cameras import add_camera_commands
from morph_dslam.cli.live import add_live_commands
from morph_dslam.cli.register import add_inner_commands, add_registration_commands
from morph_dslam.cli.track import add_tracking_commands
from morph_dslam.cli.view import add_view_commands
from morph_dslam.errors import EvaluationError, MorphError, StudyError

USER_ERROR = 2

INTERRUPTED = 130

#: Whoever read the output has stopped, `morph info sheet.morph | head` say: as a shell reports SIGPIPE.
OUTPUT_CLOSED = 141


def _build(arguments: argparse.Namespace) -> None:
    from morph_dslam.reduction.report import report_path, write_build_report
    from morph_dslam.reduction.report_pictures import read_reference_curve
    from morph_dslam.studies.build import build, build_warnings

    if arguments.output.is_dir():
        raise StudyError(f"{arguments.output} is a folder: give the name of the model file to write")
    reference = None if arguments.reference_curve is None else read_reference_curve(arguments.reference_curve)
    if arguments.scheduler is None:
        cluster = nullcontext()
    else:
        from morph_dslam.studies.sweep import cluster_executor

        cluster = cluster_executor(arguments.scheduler)
    with cluster as executor, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* nearly incompressible")  # said once, at the end
        model = build(arguments.study, arguments.output, arguments.workers, executor, compare=arguments.compare)
    report = report_path(arguments.output)
    write_build_report(report, model, reference)
    print(f"wrote {arguments.output} and {report}")
    if arguments.compare:
        from morph_dslam.reduction.comparison import comparison_lines

        print("\n".join(comparison_lines(arguments.output)))
    for line in build_warnings(model.certificate):
        print(f"warning: {line}")


def _info(arguments: argparse.Namespace) -> None:
    from morph_dslam.evaluation.model_summary import summarise_model
    from morph_dslam.model import load_model

    model = load_model(arguments.model)
    print(f"{model.name}: a reduced model of {arguments.model.stat().st_size / 1e6:.2f} MB")
    for heading, table in summarise_model(model).items():
        print(f"\n{heading}")
        for line in table.text():
            print(f"  {line}")


def _check_evaluation(arguments: argparse.Namespace) -> None:
    """Refuse options that would have no effect."""
    if arguments.depth is None and (arguments.base_frame, arguments.depth_per_metre) != (None, None):
        raise EvaluationError("--base-frame and --depth-per-metre go with --depth: leave them out")
    if arguments.points is None and arguments.bind_frame is not None:
        raise EvaluationError("--bind-frame goes with --points: leave it out")


def _evaluate(arguments: argparse.Namespace) -> None:
    _check_evaluation(arguments)
    if arguments.trajectory is not None:
        from morph_dslam.evaluation.trajectory import evaluate_trajectory, trajectory_line

        print(trajectory_line(evaluate_trajectory(arguments.run, arguments.trajectory)))
        return
    from morph_dslam.evaluation.evaluate import evaluate, evaluate_depth
    from morph_dslam.evaluation.run_folder import alignment_line, depth_line, remarks, result_line

    if arguments.depth is not None:
        found = evaluate_depth(arguments.run, arguments.depth, arguments.base_frame, arguments.depth_per_metre)
        print(f"wrote {arguments.run / 'depth_evaluation.json'} and depth_evaluation.png")
        print(depth_line(found))
        return
    if arguments.bind_frame is None:
        raise EvaluationError("--points needs --bind-frame N, the frame whose pixels bind the points to the mesh")
    figures = evaluate(arguments.run, arguments.points, arguments.bind_frame)
    for remark in remarks(figures):
        print(f"note: {remark}")
    print(f"wrote {arguments.run / 'evaluation.json'} and {arguments.run / 'report.html'}")
    print(alignment_line(figures))
    print(result_line(figures))


def _simulate(arguments: argparse.Namespace) -> None:
    from morph_dslam.render.simulation import simulate

    simulate(arguments.scene, arguments.output)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="morph", description="Track a deformable solid in video with a physics-based reduced model."
    )
    parser.add_argument("--version", action="version", version=f"morph-dslam {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_offline_commands(commands)
    add_view_commands(partial(_add, commands))
    add_tracking_commands(partial(_add, commands))
    add_live_commands(partial(_add, commands))
    _add_evaluation_commands(commands)
    add_camera_commands(partial(_add, commands))
    add_inner_commands(partial(_add, commands))
    add_registration_commands(partial(_add, commands))
    return parser


def _add(commands: argparse._SubParsersAction, name: str, action: Callable, kept: str, text: str):
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.set_defaults(action=action, kept=kept)
    return command


def _add_offline_commands(commands: argparse._SubParsersAction) -> None:
    build = _add(
        commands,
        "build",
        _build,
        "the solutions found so far are kept, and the same command goes on from there",
        "solve a study over its parameters and compress the solutions in a model file",
    )
    build.add_argument("study", type=Path, help="study file (docs/study-file.md)")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="MODEL", help="model file to write")
    where = build.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=positive_integer, metavar="N", help="processes to solve in (default: one a core)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="solve on a Dask cluster, tcp://host:8786 say (docs/clusters.md)"
    )
    build.add_argument(
        "--compare",
        action="store_true",
        help="reduce the same solutions by every other method too, and print how they compare",
    )
    build.add_argument(
        "--reference-curve",
        type=Path,
        metavar="CSV",
        help="errors of somebody else by number of modes, drawn in the report (docs/certificate.md)",
    )
    info = _add(commands, "info", _info, "nothing was written", "say what a model file holds")
    info.add_argument("model", type=Path, help="model file")
    simulate = _add(
        commands,
        "simulate",
        _simulate,
        "the frames written so far are kept, without truth",
        "film a model moving through given parameters and camera positions, with exact truth",
    )
    simulate.add_argument("scene", type=Path, help="scene file (docs/scene-file.md)")
    simulate.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")


def _add_evaluation_commands(commands: argparse._SubParsersAction) -> None:
    evaluate = _add(
        commands,
        "evaluate",
        _evaluate,
        "the run is unchanged",
        "compare a run with measured points or depth images, or its camera path with the true one",
    )
    evaluate.add_argument("run", type=Path, help="run folder, or a trajectory file")
    truth = evaluate.add_mutually_exclusive_group(required=True)
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
    evaluate.add_argument(
        "--base-frame", type=int, metavar="N", help="with --depth: a frame in which nothing is deformed"
    )
    evaluate.add_argument(
        "--depth-per-metre", type=float, metavar="V", help="with a folder of depth images: values a metre"
    )
    evaluate.add_argument(
        "--bind-frame",
        type=int,
        metavar="N",
        help="with --points: frame whose pixels bind the truth points to the mesh",
    )


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM, as batch systems send it, ends a command as Ctrl-C does: workers stop, results are kept."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _output_is_closed() -> bool:
    """Whether nobody reads what is printed; what is still to be written then goes to the null device."""
    try:
        output = sys.stdout.fileno()
    except (OSError, ValueError):  # it is no file
        return False
    poll = select.poll()
    poll.register(output, 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    return True


def run_and_report_errors(
    action: Callable[[argparse.Namespace], None], arguments: argparse.Namespace, kept: str
) -> int:
    """Run an action and return the exit status.

    0; 2 for a mistake the user can mend; 130 if interrupted; 141 if nobody reads what it prints any more.
    """
    try:
        with _terminated_as_interrupted():
            action(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        if not _output_is_closed():
            raise
        return OUTPUT_CLOSED
    except MorphError as error:
        print(f"morph: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print(f"\nmorph: interrupted; {kept}", file=sys.stderr)
        return INTERRUPTED
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status of `run_and_report_errors`."""
    given = sys.argv[1:] if arguments is None else arguments
    parsed = _parser().parse_args(with_signed_sections(given))
    return run_and_report_errors(parsed.action, parsed, parsed.kept)


if __name__ == "__main__":
    sys.exit(main())
