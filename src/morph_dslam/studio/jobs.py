"""Steps that take long: commands of the program itself, run beside the server, with their progress."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from morph_dslam.errors import StudioError

#: Lines of output that are kept.
_MOST_LINES = 400
#: A bar of tqdm, as commands print them: what, how many of how many, and the time left.
_BAR = re.compile(r"^(?:(?P<what>[^:|]*): )?\s*\d+%\|[^|]*\| *(?P<done>\d+)/(?P<total>\d+) \[\S+?<(?P<left>[\d:?]+)")
#: Seconds that a command has to keep its results before it is killed.
_PATIENCE = 60.0


@dataclass
class Job:
    """A command that runs, or the last one that ran.

    Attributes
    ----------
    kind : the command's name, such as "build".
    command : as it could be typed in the project folder.
    running : whether it runs.
    stopped : whether it was asked to stop.
    status : exit status, None while it runs.
    what : that is being done.
    done, total : of the bar that was printed last.
    left_s : seconds left by that bar, None where it does not know.
    lines : of output, the newest last.
    seconds : since the start.
    """

    kind: str
    command: str
    running: bool = True
    stopped: bool = False
    status: int | None = None
    what: str = "starting"
    done: int = 0
    total: int = 0
    left_s: float | None = None
    lines: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def take(self, line: str) -> None:
        """Take in a line of output."""
        bar = _BAR.match(line)
        if bar is None:
            self.lines = [*self.lines, line][-_MOST_LINES:]
            self.what, self.done, self.total, self.left_s = line, 0, 0, None
            return
        self.what = bar["what"] or self.what
        self.done, self.total, self.left_s = int(bar["done"]), int(bar["total"]), _seconds(bar["left"])


def _seconds(clock: str) -> float | None:
    """Seconds of "1:02:03"; None of "?"."""
    parts = clock.split(":")
    if not all(part.isdecimal() for part in parts):
        return None
    return float(sum(int(part) * 60**k for k, part in enumerate(reversed(parts))))


class Jobs:
    """Runs one command at a time in the project folder.

    Parameters
    ----------
    folder : of the project.
    changed : called when the job has news.
    """

    def __init__(self, folder: Path, changed: Callable[[], None]) -> None:
        self._folder, self._changed = folder, changed
        self._process: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task | None = None
        self._start = 0.0
        self.job: Job | None = None

    def check_idle(self) -> None:
        """Raise StudioError if a command runs."""
        if self.job is not None and self.job.running:
            raise StudioError(f"`{self.job.command}` still runs: stop it, or wait until it has ended")

    async def start(self, kind: str, words: list[str], then: Callable[[], None] = lambda: None) -> None:
        """Run ``morph`` with these words.

        Parameters
        ----------
        kind : the command's name, such as "build".
        words : of the command line.
        then : called when it has ended well, before its end is sent to the pages.

        Raises
        ------
        StudioError
            If another command runs, or the system starts none.
        """
        self.check_idle()
        # A second request must find this one while its process is made.
        before, self.job = self.job, Job(kind, shlex.join(["morph", *words]))
        self._start = time.monotonic()
        try:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "morph_dslam", *words,
                cwd=self._folder, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT, start_new_session=True,
                env=os.environ | {"PYTHONUNBUFFERED": "1", "TQDM_MININTERVAL": "0.1"},
            )  # fmt: skip
        except BaseException as error:
            self.job = before
            if isinstance(error, OSError):
                raise StudioError(f"`morph {kind}` cannot be started: {error.strerror or error}") from error
            raise
        self._task = asyncio.create_task(self._follow(self.job, self._process, then))
        self._changed()

    async def _follow(self, job: Job, process: asyncio.subprocess.Process, then: Callable[[], None]) -> None:
        assert process.stdout is not None
        rest = b""
        while data := await process.stdout.read(1 << 16):
            *lines, rest = re.split(rb"[\r\n]+", rest + data)
            for line in lines:
                if text := line.decode(errors="replace").replace("\x1b[A", "").rstrip():
                    job.take(text)
            job.seconds = time.monotonic() - self._start
            self._changed()
        if rest.strip():
            job.take(rest.decode(errors="replace").rstrip())
        job.status = await process.wait()
        job.seconds, job.running = time.monotonic() - self._start, False
        try:
            if job.status == 0:
                then()
        finally:
            self._changed()

    async def stop(self) -> None:
        """Interrupt the command as Ctrl-C does, so that it keeps what it has; nothing if none runs."""
        process, task = self._process, self._task
        if process is None or task is None or task.done():
            return
        assert self.job is not None
        self.job.stopped = True
        # Commands take it as Ctrl-C; one that has not begun ends without a word, where SIGINT would show a traceback.
        process.send_signal(signal.SIGTERM)
        try:
            await asyncio.wait_for(asyncio.shield(task), _PATIENCE)
        except TimeoutError:
            os.killpg(process.pid, signal.SIGKILL)
            await task

    def content(self) -> dict[str, Any] | None:
        """The job for a page; None if none was started."""
        return None if self.job is None else asdict(self.job)
