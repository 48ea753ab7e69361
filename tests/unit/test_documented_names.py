"""What the program accepts, writes and flags is documented, and what the documentation names exists."""

import importlib
import importlib.util
import pydoc
import re

import h5py
import numpy as np
import pytest
from pydantic import BaseModel

from morph_dslam.camera import Camera
from morph_dslam.io.camera_files import _CameraFile
from morph_dslam.mechanics.materials.library import constant_quantities, laws
from morph_dslam.notices import Notice
from morph_dslam.registration.board import BoardFile
from morph_dslam.registration.guess import GuessFile
from morph_dslam.registration.messages import RegistrationWarning
from morph_dslam.registration.picture import PictureFile
from morph_dslam.render.scene_file import Scene
from morph_dslam.slam.run_files import write_run as write_slam_run
from morph_dslam.slam.scene import finish_scene
from morph_dslam.slam.slam import Slam
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.tracking.outcomes import Status, TrackingWarning
from morph_dslam.tracking.run_folder import summarise, write_csv, write_hdf5
from morph_dslam.tracking.run_notices import RunWarning
from morph_dslam.tracking.run_results import RunResults
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import PAGES, PROJECT, code_words, commands, options
from tests.unit.test_results import frame_result


def keys_of(*roots: type[BaseModel]) -> set[str]:
    """The keys of files and of the sections in them, at any depth."""
    schemas = [root.model_json_schema() for root in roots]
    sections = [part for schema in schemas for part in (schema, *schema.get("$defs", {}).values())]
    return {name for section in sections for name in section.get("properties", {})}


@pytest.mark.parametrize(
    ("pages", "roots", "n_keys"),
    [
        (["scene-file"], [Scene], 40),
        (["cameras"], [_CameraFile], 8),
        (["registration-aids"], [BoardFile, PictureFile, GuessFile], 15),
        (["solid-study", "external-solutions"], [SolidStudy, ExternalStudy], 70),
        (["study-file", "solid-study"], [SheetStudy], 20),
        (["shell-study", "solid-study"], [ShellStudy], 45),
    ],
)
def test_every_key_is_documented(pages, roots, n_keys):
    assert len(keys_of(*roots)) >= n_keys
    named = set().union(*(code_words(page) for page in pages))
    assert keys_of(*roots) - named == set()


def test_every_law_and_its_constants_are_documented():
    """Of this package: other tests register laws of their own."""
    ours = {name for name, law in laws().items() if law.__module__.startswith("morph_dslam.")}
    assert len(ours) > 10
    for page in ("solid-study", "materials"):
        assert ours - code_words(page) == set()
    constants = {name for law in ours for name in constant_quantities(law)}
    assert constants - code_words("solid-study") == set()


def test_every_result_of_a_run_is_documented(tmp_path):
    run = RunResults(bent_sheet_model(22, 16), reference_frame=3)
    run.add(3, 0.0, frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False]))
    write_hdf5(tmp_path / "result.h5", run)
    write_csv(tmp_path / "frames.csv", run)
    with h5py.File(tmp_path / "result.h5") as file:
        found = {*file, *file.attrs, *summarise(run)}
    columns = (tmp_path / "frames.csv").read_text().splitlines()[0].split(",")
    found |= {name for name in columns if not name.startswith(("arch", "skew", "twist"))}
    assert len(found) > 45
    assert found - code_words("run-folder") == set()


def test_every_result_of_camera_tracking_is_documented(tmp_path):
    slam = Slam(Camera(640, 480, 528.0, 528.0, 320.0, 240.0))
    frame = slam.process_frame(np.zeros((480, 640, 3), np.uint8), 0, 0.0)
    found = set(write_slam_run(tmp_path, finish_scene(slam, [frame.record(is_final=False)]), {}))
    columns = (tmp_path / "frames.csv").read_text().splitlines()[0].split(",")
    found |= {name for name in columns if not name.endswith("_ms")}
    assert len(found) > 35
    assert found - code_words("slam") == set()


@pytest.mark.parametrize(
    ("page", "roots", "least"),
    [
        ("study-file", [SheetStudy], 16),
        ("solid-study", [SolidStudy], 16),
        ("external-solutions", [ExternalStudy], 9),
        ("shell-study", [ShellStudy], 16),
    ],
)
def test_every_key_in_a_table_exists(page, roots, least):
    known = keys_of(*roots) | {"relative_moduli", "times", "bulk_moduli", "prony", "density"}
    # keys of a material are those of its law; generators are values
    known |= {"block", "tube", "revolution", "extrusion", "plate", "cylinder", "sphere", "annulus", "true"}
    n_keys = 0
    for table in re.findall(r"^\| key \|.*\n\|[-|]+\n((?:\|.*\n)+)", PAGES[page], flags=re.MULTILINE):
        for row in table.splitlines():
            words = re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", row.split("|")[1])))
            assert set(words) <= known, row
            n_keys += len(words)
    assert n_keys >= least


def test_every_command_and_option_is_documented():
    everything = " ".join(PAGES.values())
    for name, parser in commands().items():
        assert re.search(rf"morph {name}\b", everything), name
        missing = {o for o in options(parser) - {"--help", "--output"} if not re.search(rf"{o}\b(?!-)", everything)}
        assert missing == set(), name


def test_options_that_pages_name_exist():
    """Of the command line, or of a program in examples/ or benchmarks/ that has it."""
    known = set().union(*map(options, commands().values()))
    for folder in ("examples", "benchmarks"):
        for path in (PROJECT / folder).rglob("*.py"):
            known |= set(re.findall(r"\"(--[a-z][\w-]*)\"", path.read_text()))
    known |= {"--fifo", "--help"}
    for page, text in PAGES.items():
        assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text)) <= known, page


def test_references_in_pages_exist():
    """`[`name`][morph_dslam.module.name]`, as mkdocstrings links a page to the function that it describes."""
    for page, text in PAGES.items():
        for name in re.findall(r"\]\[(morph_dslam[\w.]*)\]", text):
            assert pydoc.locate(name) is not None, f"{page}: {name}"


def test_every_status_and_warning_of_a_frame_is_documented():
    kinds = {kind.__name__ for kind in TrackingWarning.__subclasses__()}
    assert len(kinds) > 5
    assert (kinds | {status.value for status in Status}) - code_words("run-folder") == set()


def kinds_below(root: type[Notice]) -> set[str]:
    """Of all classes below one, as `notices` name them: ``at_bound`` for `AtBound`."""
    classes = root.__subclasses__()
    own = {re.sub(r"(?<!^)(?=[A-Z])", "_", one.__name__).lower() for one in classes}
    return own.union(*map(kinds_below, classes))


def test_every_warning_of_a_run_is_documented():
    """By the kind that its entry in summary.json has."""
    importlib.import_module("morph_dslam.tracking.still_notices")  # it has some of them
    kinds = kinds_below(RegistrationWarning) | {warning.name.lower() for warning in RunWarning} | {"remark"}
    assert {"not_at_rest", "focal_length_far_from_given", "by_outline", "rigid_fails"} < kinds
    assert kinds - code_words("run-folder") == set()


def test_results_are_those_that_were_kept(monkeypatch):
    """`docs/results.md` and the table in README.md are written by a program, not by hand."""
    monkeypatch.syspath_prepend(str(PROJECT / "benchmarks"))
    results = importlib.import_module("results")
    assert PAGES["results"] == results.page()
    assert results.readme_table() in PAGES["README"]
