"""The command line: parse, run one command, report errors as one line and an exit status.

Each command is a module beside this one with `HELP`, `KEPT` (what an interrupt leaves), `add_arguments` and
`run`. It imports what it needs when it runs, so that `morph --help` answers at once.
"""

from __future__ import annotations

import argparse
import os
import re
import select
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module

from morph_dslam._version import __version__
from morph_dslam.cli.arguments import with_signed_sections
from morph_dslam.cli.interruption import Interruption, interrupt_behind
from morph_dslam.errors import MorphError, refusal

#: Commands in the order in which `morph --help` lists them.
COMMANDS = (
    "fit", "build", "info", "simulate", "export", "explore", "track", "live", "evaluate", "slam", "calibrate", "inner",
    "register", "board", "identify", "studio", "doctor",
)  # fmt: skip
USER_ERROR = 2
INTERRUPTED = 130
#: Whoever read the output has stopped, `morph info sheet.morph | head` say: as a shell reports SIGPIPE.
OUTPUT_CLOSED = 141
#: From this likeness on (`difflib`) an option is taken for another one, misspelt.
CLOSE = 0.8
#: How often a progress bar is written into a file or a pipe, seconds. tqdm reads the variable when it is loaded.
LOGGED_EVERY = ("TQDM_MININTERVAL", "10")
#: Threads of the linear algebra of numpy and scipy, which reads the variable when it is loaded, unless the user has set
#: it: see `one_openblas_thread`.
ALGEBRA_THREADS = ("OPENBLAS_NUM_THREADS", "1")


def new_parser() -> argparse.ArgumentParser:
    """The parser of all commands; what it parses has `run`, `kept` and `command`; `main` adds `words`."""
    parser = argparse.ArgumentParser(
        prog="morph", description="Track a deformable solid in video with a physics-based reduced model."
    )
    parser.add_argument("--version", action="version", version=f"morph-dslam {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"morph_dslam.cli.{name}")
        description = module.HELP[0].upper() + module.HELP[1:] + "."
        command = commands.add_parser(name, help=module.HELP, description=description)
        command.set_defaults(run=module.run, kept=module.KEPT, command=command)
        module.add_arguments(command)
    return parser


def _not_understood(command: argparse.ArgumentParser, unknown: list[str]) -> str:
    """Message on arguments that a command does not have; argparse's own shows the usage of `morph` alone."""
    options = sorted(set(re.findall(r"--[a-z-]+", command.format_help())))
    close = [name for word in unknown for name in get_close_matches(word.partition("=")[0], options, 1, CLOSE)]
    meant = f" (do you mean {' and '.join(close)}?)" if close else ""
    message = f"{command.prog}: error: unrecognized arguments: {' '.join(unknown)}{meant}"
    return f"{message}; `{command.prog} --help` lists the options"


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

    ``kept`` says what an interrupt leaves, unless the interrupt itself brings other words. The status is
    0; 2 for a mistake the user can mend; 130 if interrupted; 141 if nobody reads what it prints any more.
    """
    try:
        with Interruption(run_and_report_errors).taken():
            action(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        if not _output_is_closed():
            raise
        return OUTPUT_CLOSED
    except MorphError as error:
        print(f"morph: {error}", file=sys.stderr)
        return USER_ERROR
    except OSError as error:
        if error.errno is None:  # of a library, not of the system
            raise
        print(f"morph: {refusal(error)}", file=sys.stderr)
        return USER_ERROR
    except (KeyboardInterrupt, SystemError) as error:
        interrupt = interrupt_behind(error)
        if interrupt is None:
            raise
        print(f"\nmorph: interrupted; {interrupt if interrupt.args else kept}", file=sys.stderr)
        return INTERRUPTED
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status of `run_and_report_errors`."""
    os.environ.setdefault(*ALGEBRA_THREADS)
    if not sys.stderr.isatty():
        os.environ.setdefault(*LOGGED_EVERY)
    given = sys.argv[1:] if arguments is None else arguments
    parser = new_parser()
    parsed, unknown = parser.parse_known_args(with_signed_sections(given))
    if unknown:
        parser.exit(USER_ERROR, f"{_not_understood(parsed.command, unknown)}\n")
    parsed.words = list(given)
    return run_and_report_errors(parsed.run, parsed, parsed.kept)
