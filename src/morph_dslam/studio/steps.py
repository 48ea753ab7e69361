"""What the steps do: each action reads files of the project, and writes one or starts one command."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from morph_dslam.errors import StudioError
from morph_dslam.studio import clicks, object_mesh, project as names, recording, study_file
from morph_dslam.studio.jobs import Jobs
from morph_dslam.studio.live_steps import LiveSteps
from morph_dslam.studio.project import Project
from morph_dslam.studio.scan_steps import ScanSteps
from morph_dslam.studio.worker import Worker

#: Seconds between two looks at the file that a run appends to.
_LOOK = 0.25
#: Unit of the mesh that the studio writes.
_UNIT = "mm"
Unit = Literal["m", "cm", "mm", "um"]
Name = Annotated[str, Field(min_length=1, max_length=80)]
Pairs = list[list[float]]
#: A length or a board as the command line takes it; never an option.
Words = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. :=-]*$", max_length=60)]


class Steps:
    """The steps of one project.

    Parameters
    ----------
    project : the folder.
    phone : gives the address that a phone opens, None if none is let in.

    Attributes
    ----------
    phone_address : the same.
    """

    def __init__(self, project: Project, phone: Callable[[], str | None] = lambda: None) -> None:
        self.project, self._worker = project, Worker()
        self.phone_address, self._arrivals = phone, 0
        self._changed = asyncio.Event()
        self._jobs = Jobs(project.folder, self._tell)
        self._ended = False
        self.scan = ScanSteps(project, self._worker, self._jobs)
        self.live = LiveSteps(project, self._worker, self._jobs, self.scan)
        self.actions: dict[str, Callable[..., Awaitable[Any]]] = {
            name: getattr(self, name)
            for name in (
                "load_object", "grow", "name_set", "forget_set", "study", "write_study", "change_study", "forms",
                "model", "build", "stop", "calibrate", "guess_camera", "start_files", "model_mesh", "fit", "save_start",
                "track", "tracked_frames", "overlay", "export", "forget_frames",
            )
        }  # fmt: skip
        self.actions |= self.live.actions
        self.actions |= self.scan.actions

    def _tell(self) -> None:
        self._changed.set()

    def recording_came(self) -> None:
        """Tell the pages that a phone has brought a recording."""
        self._arrivals += 1
        self._tell()

    def end_news(self) -> None:
        """End what is told to pages, so that their connections close."""
        self._ended = True

    async def close(self) -> None:
        """Stop the command that runs, and end the worker."""
        self.end_news()
        await self._jobs.stop()
        await self.live.relay.close()
        self._worker.close()

    # -- what there is -----------------------------------------------------------------------------

    async def state(self) -> dict[str, Any]:
        """The files of the project, what was chosen, what each step has, and the job."""
        has = self.project.has
        done = {
            "object": has(names.MESH),
            "study": has(names.STUDY) and not (await self.study())["problems"],
            "build": has(names.MODEL),
            "camera": has(names.CAMERA) and self.project.recording is not None,
            "start": self.scan.is_accepted if self.scan.is_chosen else has(names.LANDMARKS),
            "track": has(f"{names.RUN}/summary.json"),
            "results": has(f"{names.RUN}/summary.json"),
        }
        state: dict[str, Any] = {
            "folder": str(self.project.folder),
            "files": self.project.files(),
            "choices": self.project.choices,
            "done": done,
            "job": self._jobs.content(),
            "phone": self.phone_address(),
        }
        for name, path, read in (
            ("camera", names.CAMERA, clicks.camera_facts),
            ("recording", self.project.recording, recording.recording_facts),
        ):
            try:
                found = await self._worker.call(read, self.project.path(path)) if path and has(path) else None
            except StudioError as error:
                found = {"message": str(error)}
            state[name] = found
        return state

    async def news(self) -> AsyncIterator[tuple[str, Any]]:
        """The job at each change, and the lines of the frame log as they come, until the studio ends."""
        told, offset, arrivals = None, 0, self._arrivals
        while not self._ended:
            job = self._jobs.content()
            if job != told:
                told = job
                yield "job", job
            if self._arrivals != arrivals:
                arrivals = self._arrivals
                yield "recording", self.project.recording
            lines, offset = _new_lines(self.project.path(names.FRAME_LOG), offset)
            if lines is not None:
                yield "frames", lines
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), _LOOK)
            except TimeoutError:
                continue

    # -- object ------------------------------------------------------------------------------------

    async def uploaded(self, kind: str, name: str) -> dict[str, Any]:
        """Look at what was uploaded; a file that cannot be read is taken out again."""
        project = self.project
        path, _ = project.upload_path(kind, name)
        try:
            if kind == "camera":
                await self._worker.call(clicks.camera_facts, path)
                project.write(names.CAMERA, path.read_text()) if path.name != names.CAMERA else None
                project.choose(camera_from=name, camera_note=None)
            elif kind == "recording":
                await self._worker.call(recording.recording_facts, path)
                project.choose(recording=name, reference_frame=None)
            elif kind == "scan":
                await self._worker.call(recording.recording_facts, path)
                self.scan.uploaded(name)
            elif kind == "landmarks":
                await self._worker.call(clicks.read_clicks, path)
                project.write(names.LANDMARKS, path.read_text()) if path.name != names.LANDMARKS else None
        except StudioError:
            path.unlink(missing_ok=True)
            raise
        if kind == "object":
            project.choose(object=None, sets=None)
        elif kind == "frame":
            project.choose(recording=names.FRAMES, reference_frame=None)
        return {"name": name}

    async def forget_frames(self, folder: Literal["frames", "board"]) -> dict[str, Any]:
        """Take out the pictures of a recording, or of a board, before others come."""
        path = self.project.path(folder)
        for file in path.iterdir() if path.is_dir() else ():
            file.unlink()
        return {}

    async def load_object(self, file: Name, unit: Unit, size_mm: float | None = None) -> bytes:
        """The surface of a mesh file; the file, its unit and the size of cells are remembered."""
        known = self.project.choices
        size = None if size_mm is None else 1e-3 * size_mm
        surface = await self._worker.call(object_mesh.object_surface, self.project.path(file), unit, size)
        chosen = {"object": file, "unit": unit, "size_mm": size_mm}
        is_another = any(known.get(key) != value for key, value in chosen.items())
        if is_another:
            self.project.choose(**chosen, sets=None)  # faces of another mesh have other numbers
        if is_another or not self.project.has(names.MESH):
            await self._write_mesh()
        return surface

    def _object(self) -> tuple[Path, str, float | None]:
        chosen = self.project.choices
        if "object" not in chosen:
            raise StudioError("there is no object yet: drop a mesh file")
        size = chosen.get("size_mm")
        return self.project.path(chosen["object"]), chosen["unit"], None if size is None else 1e-3 * size

    async def _write_mesh(self) -> None:
        sets = self.project.choices.get("sets", {})
        await self._worker.call(object_mesh.write_object, *self._object(), sets, self.project.path(names.MESH), _UNIT)
        if not self.project.has(names.STUDY):
            title = Path(self.project.choices["object"]).stem
            self.project.write(names.STUDY, f'name = "{title}"\n\n[mesh]\nfile = "{names.MESH}"\nunit = "{_UNIT}"\n')

    async def grow(self, face: int, angle: float) -> list[int]:
        """Faces that belong to one, up to an angle in degrees between neighbours."""
        return await self._worker.call(object_mesh.grown_faces, *self._object(), face, angle)

    async def name_set(self, name: Name, faces: Annotated[list[int], Field(max_length=2_000_000)]) -> dict[str, Any]:
        """Name a set of faces; mesh.inp is written with it."""
        before = self.project.choices.get("sets", {})
        self.project.choose(sets=before | {name: faces})
        try:
            await self._write_mesh()
        except StudioError:
            self.project.choose(sets=before or None)
            raise
        return {"sets": self.project.choices["sets"]}

    async def forget_set(self, name: Name) -> dict[str, Any]:
        """Take out a named set."""
        sets = self.project.choices.get("sets", {})
        self.project.choose(sets={key: value for key, value in sets.items() if key != name})
        await self._write_mesh()
        return {"sets": self.project.choices["sets"]}

    # -- study and build ---------------------------------------------------------------------------

    async def study(self) -> dict[str, Any]:
        """The study file, and what is wrong with it."""
        return await self._worker.call(study_file.study_state, self.project.path(names.STUDY))

    async def write_study(self, text: str) -> dict[str, Any]:
        """Write the study file as it was typed; one that is not TOML is not written."""
        await self._worker.call(study_file.check_text, text)
        self.project.write(names.STUDY, text)
        return await self.study()

    async def change_study(self, section: Name, key: str | int | None = None, value: Any = None) -> dict[str, Any]:
        """Change one entry of the study file; without a value it is taken out."""
        path = self.project.path(names.STUDY)
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        return await self.write_study(await self._worker.call(study_file.changed_text, text, section, key, value))

    async def forms(self) -> dict[str, Any]:
        """Kinds of supports and loads, laws, and materials."""
        return await self._worker.call(study_file.forms)

    async def build(self) -> dict[str, Any]:
        """Start `morph build`, or go on with one that was stopped."""
        await self._jobs.start("build", ["build", names.STUDY, "-o", names.MODEL])
        return {}

    async def stop(self) -> dict[str, Any]:
        """Stop the command that runs; it keeps what it has."""
        await self._jobs.stop()
        return {}

    async def model(self) -> dict[str, Any]:
        """What the model is."""
        return await self._worker.call(clicks.model_facts, self._needed(names.MODEL, "build the model first"))

    async def explore(self, target: str) -> tuple[str, bytes] | None:
        """What the explorer answers."""
        return await self._worker.call(
            clicks.explore_answer, self._needed(names.MODEL, "build the model first"), target
        )

    def _needed(self, name: str, message: str) -> Path:
        if not self.project.has(name):
            raise StudioError(f"{name} is not there: {message}")
        return self.project.path(name)

    # -- camera ------------------------------------------------------------------------------------

    def _recording(self) -> Path:
        name = self.project.recording
        if name is None:
            raise StudioError("there is no recording yet: drop a video, or numbered images")
        return self.project.path(name)

    async def frame(self, number: int) -> bytes:
        """A frame of the recording."""
        return await self._worker.call(recording.frame_jpeg, self._recording(), number)

    async def guess_camera(self, photo: Name) -> dict[str, Any]:
        """Write a camera file with the focal length of a photograph."""
        facts = await self._worker.call(recording.recording_facts, self._recording())
        path = self.project.path(photo)
        text, words = await self._worker.call(recording.camera_from_photo, path, facts["width"], facts["height"])
        self.project.write(names.CAMERA, text)
        self.project.choose(camera_from=photo, camera_note=words)
        return {"note": words}

    async def calibrate(
        self, board: Words, square: Words, lens: Literal["radial-tangential", "fisheye"]
    ) -> dict[str, Any]:
        """Start `morph calibrate` with the pictures of a board."""
        if not self.project.has(names.BOARD):
            raise StudioError("drop pictures of the board first")
        words = ["calibrate", names.BOARD, f"--board={board}", f"--square={square}", f"--lens={lens}"]
        await self._jobs.start("calibrate", [*words, "-o", names.CAMERA])
        self.project.choose(camera_from=names.BOARD, camera_note=None)
        return {}

    # -- start -------------------------------------------------------------------------------------

    async def start_files(self) -> dict[str, Any]:
        """The pairs that were clicked before, and the frame they belong to."""
        pairs = await self._worker.call(clicks.read_clicks, self.project.path(names.LANDMARKS))
        chosen = self.project.choices
        return {"pairs": pairs, "frame": chosen.get("reference_frame"), "at_rest": chosen.get("at_rest", True)}

    async def model_mesh(self) -> bytes:
        """The undeformed surface of the model."""
        return await self._worker.call(clicks.model_surface, self._needed(names.MODEL, "build the model first"))

    async def fit(self, pairs: Pairs, at_rest: bool, quick: bool = False) -> bytes:
        """The object placed by pairs, with its overlay and the errors; quick ones start from the last fit."""
        model, camera = self._model_and_camera()
        return await self._worker.call(clicks.fit_clicks, model, camera, pairs, at_rest, quick)

    def _model_and_camera(self) -> tuple[Path, Path]:
        return (
            self._needed(names.MODEL, "build the model first"),
            self._needed(names.CAMERA, "calibrate the camera, or drop its file"),
        )

    async def save_start(self, pairs: Pairs, frame: int, at_rest: bool) -> dict[str, Any]:
        """Write landmarks.csv."""
        await self._worker.call(clicks.save_clicks, pairs, self.project.path(names.LANDMARKS))
        self.project.choose(reference_frame=frame, at_rest=at_rest)
        return {"file": names.LANDMARKS}

    # -- track and results -------------------------------------------------------------------------

    async def track(self, refine: bool = False, snap: bool = False, outline: bool = False) -> dict[str, Any]:
        """Start `morph track`."""
        self._model_and_camera()
        words = ["track", self._recording().name, "--model", names.MODEL, "--camera", names.CAMERA]
        words += self.scan.track_words() if self.scan.is_chosen else self._pairs_words(refine, snap)
        words += ["--outline"] if outline else []
        words += ["--frame-log", names.FRAME_LOG, "--overwrite", "-o", names.RUN]
        self.project.path(names.FRAME_LOG).unlink(missing_ok=True)
        await self._jobs.start("track", words)
        return {}

    def _pairs_words(self, refine: bool, snap: bool) -> list[str]:
        """The options of `morph track` that start from pairs."""
        self._needed(names.LANDMARKS, "click and save pairs first")
        chosen, words = self.project.choices, ["--landmarks", names.LANDMARKS]
        if chosen.get("reference_frame") is not None:
            words += ["--reference-frame", str(chosen["reference_frame"])]
        # A start that is known to be undeformed is not refined: what is refined counts for less than all frames tell.
        at_rest = chosen.get("at_rest", True) and not refine
        flags = {"--at-rest": at_rest, "--snap": snap, "--refine": refine}
        return words + [flag for flag, is_set in flags.items() if is_set]

    async def tracked_frames(self) -> dict[str, Any]:
        """The frames that were tracked, and the summary of the run where it is finished."""
        lines, _ = _new_lines(self.project.path(names.FRAME_LOG), 0)
        summary = self.project.path(f"{names.RUN}/summary.json")
        found = json.loads(summary.read_text()) if summary.is_file() else None
        return {"frames": (lines or {"frames": []})["frames"], "summary": found}

    async def overlay(self, frame: int) -> bytes:
        """The model over a tracked frame."""
        lines, _ = _new_lines(self.project.path(names.FRAME_LOG), 0)
        row = next((row for row in (lines or {"frames": []})["frames"] if row["frame"] == frame), None)
        if row is None or row["camera_from_object"] is None or None in row["parameters"].values():
            raise StudioError(f"the object was not tracked in frame {frame}")
        state = list(row["parameters"].values()), row["camera_from_object"]
        return await self._worker.call(clicks.overlay, *self._model_and_camera(), *state)

    async def export(self, format: Literal["vtu", "xdmf", "gltf"]) -> dict[str, Any]:
        """Start `morph export` of the tracked states."""
        table = f"{names.RUN}/frames.csv"
        self._needed(table, "track the video first")
        target = f"export-{format}"
        await self._jobs.start("export", ["export", names.MODEL, "--format", format, "--path", table, "-o", target])
        return {"folder": target}


def _new_lines(path: Path, offset: int) -> tuple[dict[str, Any] | None, int]:
    """Whole lines of a frame log since an offset, None if nothing is new; a file that was begun anew is read anew."""
    try:
        size = path.stat().st_size
    except OSError:
        return (None if offset == 0 else {"anew": True, "frames": []}), 0
    anew = size < offset
    if size == offset:
        return None, offset
    start = 0 if anew else offset
    with path.open("rb") as file:
        file.seek(start)
        text = file.read(size - start)
    text = text[: text.rfind(b"\n") + 1]
    if not text and not anew:
        return None, offset
    return {"anew": start == 0, "frames": [json.loads(line) for line in text.splitlines()]}, start + len(text)
