"""The command line: parse, run one command, report errors as one line and an exit status.

Each command is a module beside this one with `HELP`, `KEPT` (what an interrupt leaves), `add_arguments` and
`run`. It imports what it needs when it runs, so that `morph --help` answers at once.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import FrameType, TracebackType
from typing import Any

from morph_dslam._version import __version__
from morph_dslam.cli.arguments import with_signed_sections
from morph_dslam.errors import MorphError

#: Commands in the order in which `morph --help` lists them.
COMMANDS = (
    "build", "info", "simulate", "export", "explore", "track", "live", "evaluate", "slam", "calibrate", "inner",
    "register", "board", "identify", "studio", "doctor",
)  # fmt: skip
USER_ERROR = 2
INTERRUPTED = 130
#: Whoever read the output has stopped, `morph info sheet.morph | head` say: as a shell reports SIGPIPE.
OUTPUT_CLOSED = 141
#: What is done as a whole, by the names of Python's own files: a compiled module whose import is interrupted fails with
#: an error of its own, a pool whose processes are just being started waits for ever.
WHOLE = ("<frozen importlib", "concurrent/futures/process.py")
#: An interrupt that meets one of these comes again after so many seconds.
LATER_S = 0.05


def new_parser() -> argparse.ArgumentParser:
    """The parser of all commands; what it parses has `run`, the command, and `kept`."""
    parser = argparse.ArgumentParser(
        prog="morph", description="Track a deformable solid in video with a physics-based reduced model."
    )
    parser.add_argument("--version", action="version", version=f"morph-dslam {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"morph_dslam.cli.{name}")
        description = module.HELP[0].upper() + module.HELP[1:] + "."
        command = commands.add_parser(name, help=module.HELP, description=description)
        command.set_defaults(run=module.run, kept=module.KEPT)
        module.add_arguments(command)
    return parser


class _Interruption:
    """Ctrl-C, or SIGTERM as batch systems send it: the command ends, workers stop, results are kept."""

    def __init__(self) -> None:
        self._number: int = signal.SIGINT
        self._later: threading.Timer | None = None

    def _take(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, once no module is being imported and no process started."""
        self._number = number
        if not _is_whole(frame):
            raise KeyboardInterrupt
        self._come_again()

    def _come_again(self) -> None:
        self._later = threading.Timer(LATER_S, signal.pthread_kill, [threading.get_ident(), self._number])
        self._later.start()

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Raise KeyboardInterrupt where one comes."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        numbers = [signal.SIGTERM]
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as in the background
            numbers.append(signal.SIGINT)
        before = [(number, signal.signal(number, self._take)) for number in numbers]
        try:
            with self._not_lost():
                yield
        finally:
            for number, handler in before:
                signal.signal(number, handler)
            if self._later is not None:
                self._later.cancel()

    @contextmanager
    def _not_lost(self) -> Iterator[None]:
        """Raise again what met compiled code that can only print errors and go on; nothing is printed."""
        unraisable, uncaught = sys.unraisablehook, sys.excepthook

        def take_unraisable(lost: Any) -> None:
            if issubclass(lost.exc_type, KeyboardInterrupt):
                self._come_again()
            else:
                unraisable(lost)

        def take_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
            if not issubclass(kind, KeyboardInterrupt):
                uncaught(kind, error, trace)

        sys.unraisablehook, sys.excepthook = take_unraisable, take_uncaught
        try:
            yield
        finally:
            sys.unraisablehook, sys.excepthook = unraisable, uncaught


def _is_whole(frame: FrameType | None) -> bool:
    """Whether what a command does in a frame is one of `WHOLE`."""
    while frame is not None and frame.f_code is not run_and_report_errors.__code__:
        if any(name in frame.f_code.co_filename for name in WHOLE):
            return True
        frame = frame.f_back
    return False


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
        with _Interruption().taken():
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
    parsed = new_parser().parse_args(with_signed_sections(given))
    return run_and_report_errors(parsed.run, parsed, parsed.kept)
