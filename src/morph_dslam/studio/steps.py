"""What the steps do: each action reads files of the project, and writes one or starts one command."""

from __future__ import annotations

import asyncio
import filecmp
import shlex
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from morph_dslam.errors import StudioError
from morph_dslam.io.text import read_text
from morph_dslam.studio import clicks, object_mesh, project as names, recording, run_files, study_file
from morph_dslam.studio.jobs import Job, Jobs
from morph_dslam.studio.live_steps import LiveSteps
from morph_dslam.studio.project import Project
from morph_dslam.studio.scan_steps import ScanSteps
from morph_dslam.studio.worker import Worker

#: Seconds between two looks at the file that a run appends to.
_LOOK = 0.25
#: Unit of the mesh that the studio writes.
_UNIT = "mm"
Unit = Literal["m", "cm", "mm", "um"]
Name = Annotated[str, Field(min_length=1, max_length=100)]
Pairs = list[list[float]]
#: How uploads are looked at before they take the place of a file of the same name.
_CHECKS: dict[str, Callable[[Path], Any]] = {
    "camera": clicks.camera_facts, "recording": recording.recording_facts, "scan": recording.recording_facts,
    "landmarks": clicks.read_clicks,
}  # fmt: skip
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
        self._reads_earlier: tuple[Job, str] | None = None
        self.scan = ScanSteps(project, self._worker, self._jobs)
        self.live = LiveSteps(project, self._worker, self._jobs, self.scan)
        self.actions: dict[str, Callable[..., Awaitable[Any]]] = {
            name: getattr(self, name)
            for name in (
                "load_object", "grow", "name_set", "forget_set", "study", "write_study", "change_study", "forms",
                "model", "build", "stop", "calibrate", "guess_camera", "start_files", "model_mesh", "fit", "save_start",
                "track", "tracked_frames", "overlay", "export", "forget_frames", "frame_numbers",
            )
        }  # fmt: skip
        self.actions |= self.live.actions
        self.actions |= self.scan.actions

    def _tell(self) -> None:
        self.scan.job_ended()
        if self._reads_earlier is not None and not self._reads_earlier[0].running:
            (_, name), self._reads_earlier = self._reads_earlier, None
            self._outdate_run_of(name)  # what it was tracked in was replaced meanwhile
        self._changed.set()

    def recording_came(self) -> None:
        """Tell the pages that there is another recording; another page, or a phone, may have brought it."""
        self._arrivals += 1
        self._tell()

    def end_news(self) -> None:
        """End what is told to pages, so that their connections close."""
        self._ended = True

    async def close(self) -> None:
        """Stop the command that runs, and end the worker."""
        self.end_news()
        await self._jobs.stop()
        await self.live.close()
        self._worker.close()

    # -- what there is -----------------------------------------------------------------------------

    async def state(self) -> dict[str, Any]:
        """The files of the project, what was chosen, what each step has, and the job."""
        has, project = self.project.has, self.project
        problem, wrong_camera = await self._run_problem(), await self._camera_problem()
        wrong_start = await self._start_problem()
        is_tracked = has(f"{names.RUN}/summary.json") and problem is None
        done = {
            "object": has(names.MESH),
            "study": has(names.STUDY) and await self._is_study_good(),
            "build": has(names.MODEL),
            "camera": has(names.CAMERA) and self.project.recording is not None and wrong_camera is None,
            "start": self.scan.is_accepted if self.scan.is_chosen else has(names.LANDMARKS) and wrong_start is None,
            "track": is_tracked,
            "results": is_tracked,
        }
        state: dict[str, Any] = {
            "folder": str(self.project.folder),
            "files": self.project.files(),
            "choices": self.project.choices,
            "done": done,
            "job": self._jobs.content(),
            "phone": self.phone_address(),
            "notes": {
                "settings": project.damage,
                "start": project.aside or wrong_start,
                "run": problem,
                "camera": wrong_camera,
            },
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
        phone = self.phone_address()
        told, log, arrivals = None, run_files.FrameLog(self._log), self._arrivals
        while not self._ended:
            job = self._jobs.content()
            if job != told:
                told = job
                yield "job", job
            if self._arrivals != arrivals:
                arrivals = self._arrivals
                yield "recording", self.project.recording
            if self.phone_address() != phone:
                phone = self.phone_address()
                yield "phone", phone
            for lines in await asyncio.to_thread(log.new):
                yield "frames", lines
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), _LOOK)
            except TimeoutError:
                continue

    # -- object ------------------------------------------------------------------------------------

    async def uploaded(self, kind: str, name: str, part: Path) -> dict[str, Any]:
        """Look at what was uploaded, and take it in; one that cannot be read leaves the file of its name as it is.

        Parameters
        ----------
        kind, name : of the upload.
        part : the file that came.
        """
        project = self.project
        path, _ = project.upload_path(kind, name)
        await self._check_upload(kind, part, path)
        replaces = path.exists() and not await asyncio.to_thread(filecmp.cmp, part, path, shallow=False)
        path.parent.mkdir(exist_ok=True)
        part.replace(path)
        if kind == "camera":
            if path.name != names.CAMERA:
                await self._worker.call(clicks.take_camera, path, project.path(names.CAMERA))
            project.choose(camera_from=name, camera_note=None)
        elif kind == "landmarks":
            project.write(names.LANDMARKS, path.read_text(encoding="utf-8")) if path.name != names.LANDMARKS else None
            # Nobody has said of these landmarks that they show the object undeformed.
            project.choose(pairs_were_of=None, at_rest=None)
        elif kind == "scan":
            self.scan.uploaded(name)
        elif kind == "object" and replaces and project.choices.get("object") == name:
            project.choose(object=None, sets=None)
        elif kind in ("recording", "frame"):
            self._take_recording(name if kind == "recording" else names.FRAMES, replaces)
        note = await self._start_problem() if kind == "landmarks" else None
        return {"name": name, "note": project.aside if kind in ("recording", "frame") else note}

    async def _check_upload(self, kind: str, part: Path, path: Path) -> None:
        try:
            if kind == "object":
                await self._worker.call(object_mesh.check_object, part, self.project.choices.get("unit", _UNIT))
            elif kind in _CHECKS:
                await self._worker.call(_CHECKS[kind], part)
        except StudioError as error:
            kept = f"; the {path.name} that was there before is kept" if path.exists() else ""
            raise StudioError(f"{str(error).replace(str(part), path.name)}{kept}") from error

    def _take_recording(self, name: str, replaces: bool) -> None:
        """Track another recording, or the same one if nothing of it was replaced."""
        if replaces:
            self._outdate(name)
        if replaces or self.project.choices.get("recording") != name:
            self.project.take_recording(name, is_another=replaces)
            self.recording_came()

    def _outdate(self, name: str) -> None:
        self._outdate_run_of(name)
        self.scan.recording_replaced(name)

    def _outdate_run_of(self, name: str) -> None:
        """What has this name is replaced: a run of it, also one that is still tracked, is of what was there before."""
        if run_files.run_of(self.project.path(names.RUN), names.LIVE) == name:
            self.project.outdate_run()
        job = self._jobs.job
        if job is not None and job.running and job.kind == "track" and name in shlex.split(job.command):
            self._reads_earlier = job, name

    async def forget_frames(self, folder: Literal["frames", "board"]) -> dict[str, Any]:
        """Take out the pictures of a recording, or of a board, before others come."""
        path = self.project.path(folder)
        files = list(path.iterdir()) if path.is_dir() else []
        if files and folder == names.FRAMES:
            self._outdate(folder)
            if self.project.choices.get("recording") == folder:
                self.project.set_aside_pairs()
                self.recording_came()
        for file in files:
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

    async def _is_study_good(self) -> bool:
        try:
            return not (await self.study())["problems"]
        except StudioError:  # it takes too long to be read, which is said where it is opened
            return False

    async def write_study(self, text: str) -> dict[str, Any]:
        """Write the study file as it was typed; one that is not TOML is not written."""
        await self._worker.call(study_file.check_text, text)
        self.project.write(names.STUDY, text)
        return await self.study()

    async def change_study(self, section: Name, key: str | int | None = None, value: Any = None) -> dict[str, Any]:
        """Change one entry of the study file; without a value it is taken out."""
        path = self.project.path(names.STUDY)
        text = read_text(path, "study", StudioError) if path.is_file() else ""
        return await self.write_study(await self._worker.call(study_file.changed_text, text, section, key, value))

    async def forms(self) -> dict[str, Any]:
        """Kinds of supports and loads, laws, and materials."""
        return await self._worker.call(study_file.forms)

    async def build(self) -> dict[str, Any]:
        """Start `morph build`, or go on with one that was stopped."""
        self._jobs.check_idle()
        self.project.needed(names.STUDY, "load the object, and describe the study first")
        await self._jobs.start("build", ["build", names.STUDY, "-o", names.MODEL])
        return {}

    async def stop(self) -> dict[str, Any]:
        """Stop the command that runs; it keeps what it has."""
        await self._jobs.stop()
        return {}

    async def model(self) -> dict[str, Any]:
        """What the model is."""
        return await self._worker.call(clicks.model_facts, self.project.needed(names.MODEL, "build the model first"))

    async def explore(self, target: str) -> tuple[str, bytes] | None:
        """What the explorer answers."""
        return await self._worker.call(
            clicks.explore_answer, self.project.needed(names.MODEL, "build the model first"), target
        )

    # -- camera ------------------------------------------------------------------------------------

    def _recording(self) -> Path:
        name = self.project.recording
        if name is None:
            raise StudioError("there is no recording yet: drop a video, or numbered images")
        return self.project.path(name)

    async def frame(self, number: int) -> bytes:
        """A frame of the recording."""
        return await self._worker.call(recording.frame_jpeg, self._recording(), number)

    async def frame_numbers(self) -> dict[str, Any]:
        """Numbers of the recording's frames, null where none is missing between the first and the last."""
        return {"numbers": await self._worker.call(recording.frame_numbers, self._recording())}

    async def _camera_problem(self) -> str | None:
        """Why the camera file is not that of the recording; None if it may be, or if either is not there."""
        name = self.project.recording
        if name is None or not (self.project.has(name) and self.project.has(names.CAMERA)):
            return None
        try:
            facts = await self._worker.call(recording.recording_facts, self.project.path(name))
            camera = self.project.path(names.CAMERA)
            return await self._worker.call(clicks.camera_problem, camera, facts["width"], facts["height"])
        except StudioError:
            return None  # one of them cannot be read, which is said of it

    async def _check_camera(self) -> None:
        problem = await self._camera_problem()
        if problem is not None:
            raise StudioError(problem)

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
        words += ["-o", names.CAMERA]
        await self._jobs.start(
            "calibrate", words, lambda: self.project.choose(camera_from=names.BOARD, camera_note=None)
        )
        return {}

    # -- start -------------------------------------------------------------------------------------

    async def start_files(self) -> dict[str, Any]:
        """The pairs that were clicked before, and the frame they belong to."""
        pairs = await self._worker.call(clicks.read_clicks, self.project.path(names.LANDMARKS))
        chosen = self.project.choices
        return {"pairs": pairs, "frame": chosen.get("reference_frame"), "at_rest": chosen.get("at_rest", False)}

    async def _start_problem(self) -> str | None:
        """Why the landmarks do not belong to the model; None if they may, or if either is not there."""
        project = self.project
        if self.scan.is_chosen or not (project.has(names.LANDMARKS) and project.has(names.MODEL)):
            return None
        try:
            model, landmarks = project.path(names.MODEL), project.path(names.LANDMARKS)
            return await self._worker.call(clicks.landmarks_problem, model, landmarks)
        except StudioError:
            return None  # one of them cannot be read, which is said of it

    async def model_mesh(self) -> bytes:
        """The undeformed surface of the model."""
        return await self._worker.call(clicks.model_surface, self.project.needed(names.MODEL, "build the model first"))

    async def fit(self, pairs: Pairs, at_rest: bool, quick: bool = False) -> bytes:
        """The object placed by pairs, with its overlay and the errors; quick ones start from the last fit."""
        model, camera = self._model_and_camera()
        await self._check_camera()
        return await self._worker.call(clicks.fit_clicks, model, camera, pairs, at_rest, quick)

    def _model_and_camera(self) -> tuple[Path, Path]:
        return (
            self.project.needed(names.MODEL, "build the model first"),
            self.project.needed(names.CAMERA, "calibrate the camera, or drop its file"),
        )

    async def save_start(
        self, pairs: Pairs, frame: int, at_rest: bool, recording_number: int | None = None
    ) -> dict[str, Any]:
        """Write landmarks.csv; with the number of the recording that was clicked on, only if that is still the one."""
        if recording_number not in (None, self.project.recording_number):
            raise StudioError("the recording was replaced while these pairs were clicked: load this page again")
        await self._worker.call(clicks.save_clicks, pairs, self.project.path(names.LANDMARKS))
        self.project.choose(reference_frame=frame, at_rest=at_rest, pairs_were_of=None)
        return {"file": names.LANDMARKS}

    # -- track and results -------------------------------------------------------------------------

    async def track(self, refine: bool = False, snap: bool = False, outline: bool = False) -> dict[str, Any]:
        """Start `morph track`, which begins the frame log anew when it has read what it needs."""
        self._jobs.check_idle()
        self._model_and_camera()
        await self._check_camera()
        words = ["track", self._recording().name, "--model", names.MODEL, "--camera", names.CAMERA]
        words += self.scan.track_words() if self.scan.is_chosen else self._pairs_words(refine, snap)
        words += ["--outline"] if outline else []
        words += ["--frame-log", names.FRAME_LOG, "--overwrite", "-o", names.RUN]
        run_files.clear_broken_log(self._log)
        await self._jobs.start("track", words)
        return {}

    def _pairs_words(self, refine: bool, snap: bool) -> list[str]:
        """The options of `morph track` that start from pairs."""
        self.project.needed(names.LANDMARKS, "click and save pairs first")
        chosen, words = self.project.choices, ["--landmarks", names.LANDMARKS]
        if chosen.get("reference_frame") is not None:
            words += ["--reference-frame", str(chosen["reference_frame"])]
        # A start that is known to be undeformed is not refined: what is refined counts for less than all frames tell.
        at_rest = chosen.get("at_rest", False) and not refine
        flags = {"--at-rest": at_rest, "--snap": snap, "--refine": refine}
        return words + [flag for flag, is_set in flags.items() if is_set]

    async def _run_problem(self) -> str | None:
        """Why the run cannot be shown over the recording with the model; None if it can, or if there is none."""
        run = self.project.path(names.RUN)
        name, now = run_files.run_of(run, names.LIVE), self.project.choices.get("recording")
        if name is None:
            return None
        if name != now:
            return f"this run is of {name}, and the recording is {now or 'not there'}: track again"
        if self.project.is_run_outdated:
            return f"this run is of an earlier {name}, which was replaced: track again"
        return await self._model_problem()

    async def _model_problem(self) -> str | None:
        """Why the run's states are none of the model; None if they are."""
        run, model = self.project.path(names.RUN), self.project.path(names.MODEL)
        try:
            is_same = await self._worker.call(run_files.is_of_model, run, model)
        except StudioError as error:
            return str(error)
        own = f"{names.RUN}/{names.MODEL}"
        return None if is_same else f"this run is of another model, kept as {own}, than {names.MODEL}: track again"

    async def tracked_frames(self) -> dict[str, Any]:
        """The frames of the run, its summary, and why it cannot be shown; without a run, those tracked so far."""
        run = self.project.path(names.RUN)
        frames = await self._worker.call(run_files.run_frames, run)
        summary = await self._worker.call(run_files.run_summary, run)
        frames = await self._worker.call(run_files.logged_frames, self._log) if frames is None else frames
        return {"frames": frames, "summary": summary, "problem": await self._run_problem()}

    @property
    def _log(self) -> Path:
        return self.project.path(names.FRAME_LOG)

    async def overlay(self, frame: int, of: Literal["run", "log"] = "run") -> bytes:
        """The model over a frame of the run, or of the frame log, which has those that are being tracked."""
        job = self._jobs.job
        is_tracking = job is not None and job.running and job.kind in ("track", "live")
        problem = None if is_tracking and of == "log" else await self._run_problem()
        if problem is not None:
            raise StudioError(problem)
        model, camera = self._model_and_camera()
        run = self.project.path(names.RUN)
        if of == "run" and (run / "result.h5").is_file():
            return await self._worker.call(run_files.run_overlay, run, model, camera, frame)
        return await self._worker.call(run_files.log_overlay, self._log, model, camera, frame)

    async def export(self, format: Literal["vtu", "xdmf", "gltf"]) -> dict[str, Any]:
        """Start `morph export` of the tracked states."""
        table = f"{names.RUN}/frames.csv"
        self.project.needed(table, "track the video first")
        problem = await self._model_problem()
        if problem is not None:
            raise StudioError(problem)
        target = f"export-{format}"
        await self._jobs.start("export", ["export", names.MODEL, "--format", format, "--path", table, "-o", target])
        return {"folder": target}
