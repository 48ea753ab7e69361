"""The start by a scan: the still scene is mapped, the object is found in its map, and the user accepts the place."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from morph_dslam.errors import StudioError
from morph_dslam.studio import places, project as names, recording
from morph_dslam.studio.clicks import camera_facts
from morph_dslam.studio.jobs import Job, Jobs
from morph_dslam.studio.project import Project
from morph_dslam.studio.worker import Worker

#: What `morph slam` and `morph register` write, and the pairs that hint at a place.
_MAP, _MAP_SUMMARY = "map/map.h5", "map/summary.json"
_PLACE, _PLACE_PICTURE = "place/registration.json", "place/registration.jpg"
_HINTS = "scan_landmarks.csv"
_Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
_Frame = Annotated[int, Field(ge=0, le=10**9)]
_Number = Annotated[int, Field(ge=0, le=100)]


class ScanSteps:
    """The start by a scan of one project.

    Parameters
    ----------
    project : the folder.
    worker : reads files.
    jobs : runs `morph slam` and `morph register`.

    Attributes
    ----------
    actions : by name.
    """

    def __init__(self, project: Project, worker: Worker, jobs: Jobs) -> None:
        self._project, self._worker, self._jobs = project, worker, jobs
        self._discarded: Job | None = None
        self.actions: dict[str, Callable[..., Awaitable[Any]]] = {
            "start_by": self.start_by,
            "scan": self.scan,
            "scan_the_recording": self.scan_the_recording,
            "map_scan": self.map_scan,
            "find_place": self.find_place,
            "place_overlay": self.place_overlay,
            "accept_place": self.accept_place,
        }

    @property
    def is_chosen(self) -> bool:
        """Whether a scan gives the start, not pairs in a frame."""
        return self._project.choices.get("start") == "scan"

    @property
    def is_accepted(self) -> bool:
        """Whether the place that was found last is accepted."""
        accepted, path = self._project.choices.get("place"), self._project.path(_PLACE)
        return isinstance(accepted, dict) and path.is_file() and accepted.get("sha256") == _checksum(path.read_bytes())

    def track_words(self) -> list[str]:
        """The options of `morph track` that start from the place.

        Raises
        ------
        StudioError
            If none is accepted.
        """
        if not self.is_accepted:
            raise StudioError("no place in the scan is accepted: look at it in the step Start")
        return ["--map", _MAP, "--registration", _PLACE]

    async def start_by(self, way: Literal["pairs", "scan"]) -> dict[str, Any]:
        """Choose what gives the start."""
        self._project.choose(start=way)
        return {}

    def uploaded(self, name: str) -> None:
        """Take a recording of its own as the scan."""
        self._forget_map()
        self._project.choose(scan=name)

    def recording_replaced(self, name: str) -> None:
        """Forget the map of the recording that had this name: its keyframes are no frames of the new one."""
        if self._project.choices.get("mapped") == name:
            self._forget_map()

    def job_ended(self) -> None:
        """Forget what a command wrote whose scan was replaced while it ran."""
        if self._discarded is not None and not self._discarded.running:
            self._forget_map()

    async def scan_the_recording(self) -> dict[str, Any]:
        """Take the recording that is tracked as the scan, too."""
        self._forget_map()
        self._project.choose(scan=None)
        return {}

    def _source(self) -> str:
        """Name of the recording that the map is of, also where another one has come since; or would be of."""
        mapped = self._project.choices.get("mapped")
        if isinstance(mapped, str) and self._project.has(mapped):
            return mapped
        return self._source_to_map()

    def _source_to_map(self) -> str:
        """Name of the recording that a map would be made of."""
        chosen = self._project.choices.get("scan")
        if isinstance(chosen, str) and self._project.has(f"{names.SCAN}/{chosen}"):
            return f"{names.SCAN}/{chosen}"
        if self._project.recording is None:
            raise StudioError("there is no recording yet: drop a video, or numbered images")
        return self._project.recording

    async def scan(self) -> dict[str, Any]:
        """The scan, its map, and the place that was found in it, as far as they are there."""
        source, summary = self._source(), self._project.path(_MAP_SUMMARY)
        found: dict[str, Any] = {
            "source": source,
            "is_own": source.startswith(f"{names.SCAN}/"),
            "recording": await self._worker.call(recording.recording_facts, self._project.path(source)),
            "last": self._project.choices.get("scan_last"),
            "map": None,
            "place": None,
            "problem": None,
        }
        if not (summary.is_file() and self._project.has(_MAP)):
            return found
        model, camera = self._model_and_camera()
        try:
            keyframes = await self._worker.call(places.map_keyframes, self._project.path(_MAP), camera)
            found["map"] = json.loads(summary.read_text(encoding="utf-8")) | {"keyframes": keyframes}
            if self._project.has(_PLACE):
                place = await self._worker.call(places.place_facts, model, self._project.path(_PLACE))
                accepted = self._project.choices.get("place") if self.is_accepted else None
                found["place"] = place | {"accepted": accepted}
        except StudioError as error:  # another camera or model came since
            found["problem"] = str(error)
        return found

    async def frame(self, number: int) -> bytes:
        """A frame of the scan."""
        return await self._worker.call(recording.frame_jpeg, self._project.path(self._source()), number)

    def _model_and_camera(self) -> tuple[Path, Path]:
        needed = self._project.needed
        return needed(names.MODEL, "build the model first"), needed(names.CAMERA, "give the camera first")

    async def map_scan(self, last: _Frame | None = None) -> dict[str, Any]:
        """Start `morph slam` with the frames up to one; a place in an earlier map is forgotten."""
        self._jobs.check_idle()
        _, camera = self._model_and_camera()
        source = self._source_to_map()
        facts = await self._worker.call(recording.recording_facts, self._project.path(source))
        lens = await self._worker.call(camera_facts, camera)
        if (facts["width"], facts["height"]) != (lens["width"], lens["height"]):
            raise StudioError(
                f"the scan has images of {facts['width']} x {facts['height']} pixels, and the camera file is for "
                f"{lens['width']} x {lens['height']}: scan with the camera and the size of the recording"
            )
        first = facts["first"]
        if last is not None and last <= first:
            raise StudioError(f"the scan ends after frame {first}, its first one: choose a later last frame")
        self._forget_map()
        words = ["slam", source, "--camera", names.CAMERA]
        words += [] if last is None else ["--range", f"{first}-{last}"]
        await self._jobs.start("slam", [*words, "--no-video", "--overwrite", "-o", _MAP.partition("/")[0]])
        self._project.choose(scan_last=last, mapped=source)
        return {}

    def _forget_map(self) -> None:
        job = self._jobs.job
        is_made = job is not None and job.running and job.kind in ("slam", "register")
        self._discarded = job if is_made else None
        self._forget_place()
        self._project.path(_MAP_SUMMARY).unlink(missing_ok=True)
        self._project.choose(mapped=None)

    def _forget_place(self) -> None:
        for name in (_PLACE, _PLACE_PICTURE):
            self._project.path(name).unlink(missing_ok=True)
        self._project.choose(place=None)

    async def find_place(
        self,
        pairs: list[list[float]] | None = None,
        frame: _Frame | None = None,
        distance: Annotated[float, Field(gt=0, le=1e6)] | None = None,
        region: Annotated[list[_Pixel], Field(min_length=4, max_length=4)] | None = None,
        rival: _Number | None = None,
    ) -> dict[str, Any]:
        """Start `morph register`, with what hints at the place: pairs, a box in a keyframe, or a place beside."""
        self._jobs.check_idle()
        if not self._project.has(_MAP):
            raise StudioError("there is no map of the scan yet: map it first")
        if frame is None and (pairs or region or rival is not None):
            raise StudioError("pairs, a box and another place belong to a keyframe: say its number")
        model, camera = self._model_and_camera()
        words = ["register", _MAP, "--model", names.MODEL, "--camera", names.CAMERA]
        hints = self._project.path(_HINTS)
        if rival is not None:
            found = self._project.path(_PLACE)
            await self._worker.call(
                places.save_rival, model, camera, self._project.path(_MAP), found, frame, rival, hints
            )
            words += ["--landmarks", _HINTS]
        elif pairs:
            await self._worker.call(places.save_pairs, pairs, frame, hints)
            words += ["--landmarks", _HINTS]
        words += [] if distance is None else [f"--distance={distance:g}"]
        words += [] if region is None else [f"--region={frame}:{','.join(f'{value:g}' for value in region)}"]
        self._forget_place()
        await self._jobs.start("register", [*words, "-o", _PLACE.partition("/")[0]])
        return {}

    async def place_overlay(self, frame: _Frame, rival: _Number | None = None) -> bytes:
        """The undeformed object over a keyframe, where it was found, or at one of the other places."""
        model, camera = self._model_and_camera()
        files = (self._project.path(_MAP), self._project.path(_PLACE))
        return await self._worker.call(places.place_overlay, model, camera, *files, frame, rival)

    async def accept_place(self, despite_ambiguity: bool = False) -> dict[str, Any]:
        """Take the place as the start; one that is ambiguous only if that is meant, and then it is kept that it was."""
        model, _ = self._model_and_camera()
        path = self._project.path(_PLACE)
        facts = await self._worker.call(places.place_facts, model, path)
        if facts["ambiguous"] and not despite_ambiguity:
            raise StudioError("the place is ambiguous: look at every keyframe, and say that it is right all the same")
        accepted = {"sha256": _checksum(path.read_bytes()), "ambiguous": facts["ambiguous"]}
        self._project.choose(start="scan", place=accepted)
        return accepted


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
