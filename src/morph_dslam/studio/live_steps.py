"""What the pages do with live frames: take one to click pairs on, and track those that follow."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from morph_dslam.errors import StudioError
from morph_dslam.studio import clicks, project as names, recording
from morph_dslam.studio.jobs import Jobs
from morph_dslam.studio.live import LiveRelay, Size
from morph_dslam.studio.project import Project
from morph_dslam.studio.run_files import clear_broken_log, run_of
from morph_dslam.studio.scan_steps import ScanSteps
from morph_dslam.studio.worker import Worker

#: Bytes of frames of a run that are kept; those beyond are tracked only.
_MOST_KEPT = names.UPLOADS["recording"].largest
_NO_CAMERA = "no camera sends frames: start the camera of this computer, or press Live on the phone"


class LiveSteps:
    """Live frames of one project. The folder ``live`` holds the frame of the start as number 0, and those tracked.

    Parameters
    ----------
    project : the folder.
    worker : reads files.
    jobs : runs `morph live`.
    scan : may give the start in place of pairs.

    Attributes
    ----------
    relay : of the frames.
    actions : by name.
    """

    def __init__(self, project: Project, worker: Worker, jobs: Jobs, scan: ScanSteps) -> None:
        self._project, self._worker, self._jobs, self._scan = project, worker, jobs, scan
        self.relay = LiveRelay(self._wanted_size, self._keep, self._begin)
        self.actions: dict[str, Callable[..., Awaitable[Any]]] = {
            "take_frame": self.take_frame,
            "go_live": self.go_live,
        }
        self._camera: tuple[tuple[int, int], Size | None] = (0, 0), None
        self._kept, self._has_begun, self._by_scan = 0, True, False
        # One after the other, so that frames that came before the run began are in their place when others follow.
        self._disk = ThreadPoolExecutor(1)

    async def close(self) -> None:
        """End the connections of camera and command, once all frames are written."""
        await self.relay.close()
        await asyncio.to_thread(self._disk.shutdown)

    async def _wanted_size(self) -> Size | None:
        """The size of images by the camera file; None if there is none that can be read."""
        path = self._project.path(names.CAMERA)
        now = names.stamp(path)
        if now != self._camera[0]:
            try:
                facts = await self._worker.call(clicks.camera_facts, path) if now[1] else None
            except StudioError:
                facts = None
            self._camera = now, None if facts is None else (facts["width"], facts["height"])
        return self._camera[1]

    def _keep(self, number: int, jpeg: bytes) -> None:
        """Write a frame that is tracked, without waiting for the disk.

        Until the first one is tracked they stand apart: if none is, those of the run before are still there.
        """
        job = self._jobs.job
        if job is None or job.kind != "live" or not job.running or self._kept + len(jpeg) > _MOST_KEPT:
            return
        self._kept += len(jpeg)
        folder = self._project.path(names.LIVE) if self._has_begun else self._coming
        self._disk.submit(_write, folder / f"{number:06d}.jpg", jpeg)

    @property
    def _coming(self) -> Path:
        """Hidden folder of frames that a run has been given and has not yet answered."""
        return self._project.folder / f".{names.LIVE}"

    def _begin(self) -> None:
        """The first frame is tracked: the frames of the run before give way to those that come."""
        job, project = self._jobs.job, self._project
        if self._has_begun or job is None or job.kind != "live":
            return
        self._has_begun = True
        run, folder = project.path(names.RUN), project.path(names.LIVE)
        if run_of(run, names.LIVE) == names.LIVE:
            project.outdate_run()
        self._disk.submit(_replace_frames, folder, self._coming, keeps_start=not self._by_scan)
        project.choose(recording=names.LIVE, reference_frame=None if self._by_scan else 0)

    def _start_frame(self, name: str) -> Path:
        """Where number 0 of the live frames is to be written, in place of the one that is there."""
        folder = self._project.path(names.LIVE)
        folder.mkdir(exist_ok=True)
        for file in _start_files(folder):
            file.unlink()
        return folder / name

    async def take_frame(self) -> dict[str, Any]:
        """Take the newest frame as number 0 of the recording ``live``, to click pairs on; earlier ones are set aside.

        Frames of an earlier live run are kept until another one has begun.
        """
        self._jobs.check_idle()
        jpeg = self.relay.newest
        if jpeg is None:
            raise StudioError(_NO_CAMERA)
        await self._worker.call(recording.check_jpeg, jpeg)
        self._start_frame("000000.jpg").write_bytes(jpeg)
        self._project.set_aside_pairs()
        self._project.choose(recording=names.LIVE, reference_frame=0)
        return {"recording": names.LIVE, "note": self._project.aside}

    async def go_live(self, snap: bool = False, outline: bool = False) -> dict[str, Any]:
        """Start `morph live` with the camera that sends, from the frame with pairs, or from the place in the scan."""
        self._jobs.check_idle()
        self._project.needed(names.MODEL, "build the model first")
        self._project.needed(names.CAMERA, "calibrate the camera, or drop its file")
        if self.relay.newest is None:
            raise StudioError(self.relay.facts()["refused"] or _NO_CAMERA)
        words = ["live", str(await self.relay.listen()), "--model", names.MODEL, "--camera", names.CAMERA]
        by_scan = self._scan.is_chosen
        words += self._scan.track_words() if by_scan else await self._pairs_words(snap)
        words += ["--outline"] if outline else []
        words += ["--frame-log", names.FRAME_LOG, "--overwrite", "-o", names.RUN]
        self._jobs.check_idle()  # another one may have begun while the reference was written
        shutil.rmtree(self._coming, ignore_errors=True)
        self._coming.mkdir(exist_ok=True)
        self._kept, self._has_begun, self._by_scan = 0, False, by_scan
        clear_broken_log(self._project.path(names.FRAME_LOG))
        await self._jobs.start("live", words)
        return {}

    async def _pairs_words(self, snap: bool) -> list[str]:
        """The options of `morph live` that start from pairs, in their frame."""
        self._project.needed(names.LANDMARKS, "take a frame, click pairs on it, and save them")
        flags = {"--at-rest": self._project.choices.get("at_rest", False), "--snap": snap}
        words = ["--landmarks", names.LANDMARKS, *(flag for flag, is_set in flags.items() if is_set)]
        return [*words, "--reference-image", await self._write_reference()]

    async def _write_reference(self) -> str:
        """Write the frame that the pairs belong to as number 0 of the live frames; returns its name."""
        chosen, name = self._project.choices, self._project.recording
        if name is None:
            raise StudioError("the recording that the pairs were clicked on is not there: take a frame, and click anew")
        path, part = self._project.path(name), self._project.path("reference.png")
        await self._worker.call(recording.save_frame, path, chosen.get("reference_frame"), part)
        part.replace(self._start_frame("000000.png"))
        return f"{names.LIVE}/000000.png"


def _start_files(folder: Path) -> list[Path]:
    """Files of number 0."""
    return [path for path in folder.iterdir() if path.stem.isdecimal() and int(path.stem) == 0]


def _replace_frames(folder: Path, coming: Path, keeps_start: bool) -> None:
    """Put the frames of one folder in place of those of another, of which number 0 may be kept."""
    with suppress(OSError):  # the disk may be full: frames are tracked all the same
        folder.mkdir(exist_ok=True)
        kept = _start_files(folder) if keeps_start else []
        for path in set(folder.iterdir()) - set(kept):
            path.unlink()
        for path in coming.iterdir():
            path.replace(folder / path.name)
        coming.rmdir()


def _write(path: Path, content: bytes) -> None:
    with suppress(OSError):  # the disk may be full: the frame is tracked all the same
        path.write_bytes(content)
