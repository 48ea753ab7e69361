"""Recordings that several test files share, each made once in a run, whatever the number of workers.

A shared folder is only read; what a test writes goes into its own ``tmp_path``.
"""

import fcntl
import gc
import os
import shutil
import signal
from contextlib import contextmanager, nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from morph_dslam.cli.app import main
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.tracking import run_plots
from tests.support.rendered_anchored import make_anchored_recording
from tests.support.rendered_anchored_rig import (
    load_truth,
    make_left_recording,
    make_mirrored_recording,
    make_rig_recording,
)
from tests.support.rendered_room import RoomFilm, hand_held, write_film

#: What is in a figure that is not drawn.
BLANK = {
    "png": cv2.imencode(".png", np.full((8, 8), 255, dtype=np.uint8))[1].tobytes(),
    "svg": b'<svg xmlns="http://www.w3.org/2000/svg"/>',
}


def pytest_configure(config):
    cv2.setNumThreads(1)
    gc.disable()  # until all is imported


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """One worker compiles a file of tests, and the others read what it has left; each would compile all files."""
    if "PYTEST_XDIST_WORKER" not in os.environ or not isinstance(collector, pytest.Module):
        return (yield)
    lock = Path(collector.config.option.basetemp).parent / f"{collector.nodeid.replace('/', '.')}.lock"
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        return (yield)


def pytest_collection_modifyitems(items):
    """Begin with one file that compiles the tracker, and with the mechanics, lest all workers compile the same."""
    first = ("tests/integration/test_anchored.py", "tests/verification/")
    items.sort(key=lambda item: next((k for k, start in enumerate(first) if item.nodeid.startswith(start)), len(first)))


def pytest_collection_finish():
    """All that is imported stays: to look for garbage in it takes a tenth of a second, at each run of a tracker.

    What is compiled stays too: where garbage is looked for as often as Python does, that takes a tenth of compiling.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def blank_figures():
    """Figures that tests have saved are blank: to draw those of a run takes longer than to track it.

    A quarter of the time of a short run is the axes of its plots, which are not made either. Slow tests draw, and those
    that ask for `drawn_figures`. Gives contexts for fixtures of wider scope that do.
    """
    save = Figure.savefig
    plots = {name: plot for name, plot in vars(run_plots).items() if name.startswith("plot_")}

    def save_blank(self, path, **options):
        content = BLANK.get(options.get("format", str(path)[-3:]))
        if content is None:
            save(self, path, **options)
        elif hasattr(path, "write"):
            path.write(content)
        else:
            Path(path).write_bytes(content)

    @contextmanager
    def drawn():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Figure, "savefig", save)
            for name, plot in plots.items():
                patch.setattr(run_plots, name, plot)
            yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", save_blank)
        for name in plots:
            patch.setattr(run_plots, name, lambda path, run: path.write_bytes(BLANK["png"]))
        yield drawn


@pytest.fixture
def drawn_figures(blank_figures):
    """Figures are drawn."""
    with blank_figures():
        yield


@pytest.fixture(autouse=True)
def figures_of_slow_tests(request, blank_figures):
    """Are drawn."""
    with blank_figures() if request.node.get_closest_marker("slow") else nullcontext():
        yield


@pytest.fixture
def refused(capsys):
    """A function that runs a command, which must end with status 2 and one message, and returns the message."""

    def message_of(*words) -> str:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as usage:
            status = usage.code
        said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("morph")]
        assert (status, len(said)) == (2, 1), said
        return said[0]

    return message_of


@pytest.fixture
def ends_in_time():
    """Raises in a test that still waits after two minutes, for a message that does not come say; it would hang all."""

    def late(*_):
        raise TimeoutError("the test still waits after two minutes")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def interruptible():
    """As in a terminal; what a shell runs in the background ignores Ctrl-C, and so do the tests there."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """A function that returns folder ``name`` of this run, filled by ``make(folder)`` in the worker that asks first."""
    root = tmp_path_factory.getbasetemp()
    root = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "shared"

    def get(name, make) -> Path:
        folder = root / name
        root.mkdir(exist_ok=True)
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / ".made").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / ".made").touch()
        return folder

    return get


@pytest.fixture(scope="session")
def room_film(made_once):
    """80 grey images of a rendered room, and world_from_camera (80, 4, 4)."""

    def make(folder):
        film, path = RoomFilm(seed=1), hand_held(80, seed=1)
        np.save(folder / "images.npy", np.array([film.frame(place) for place in path]))
        np.save(folder / "path.npy", path)

    folder = made_once("room", make)
    return list(np.load(folder / "images.npy")), np.load(folder / "path.npy")


@pytest.fixture(scope="session")
def room_folder(room_film, made_once):
    """The first 40 frames of the room: `film/`, `camera.yaml` and `truth.txt`."""

    def make(folder):
        write_film(folder, room_film[0][:40])
        save_trajectory(folder / "truth.txt", Trajectory(np.arange(40) / 30.0, room_film[1][:40]))

    return made_once("room_folder", make)


@pytest.fixture(scope="session")
def anchored_recording(made_once):
    """Folder and truth of `make_anchored_recording`."""
    folder = made_once("anchored", make_anchored_recording)
    with np.load(folder / "sequence" / "truth.npz") as truth:
        return folder, dict(truth)


@pytest.fixture(scope="session")
def rig_recording(made_once):
    """Folder and truth of `make_rig_recording`."""
    folder = made_once("rig", make_rig_recording)
    return folder, load_truth(folder)


@pytest.fixture(scope="session")
def left_recording(rig_recording, made_once):
    """Folder and truth of `make_left_recording`: all of the rig's recording, and `left/`."""
    folder = made_once("left", lambda folder: make_left_recording(rig_recording[0], folder))
    return folder, load_truth(folder)


@pytest.fixture(scope="session")
def mirrored_recording(left_recording, made_once):
    """Folder and truth of `make_mirrored_recording`: all of the rig's recordings, `both/` and `mirrored/`."""
    folder = made_once("mirrored", lambda folder: make_mirrored_recording(left_recording[0], folder))
    return folder, load_truth(folder)
