"""The tutorials and the page on extensions, step by step as they stand: commands and programs are run."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from morph_dslam.cli.app import main
from tests.support.scenes import MOTION, write_scene

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mpl.use("agg")


def blocks_of(page):
    """Language, file name and text of each fenced block."""
    pattern = r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$"
    return re.findall(pattern, (DOCS / page).read_text(), re.DOTALL | re.MULTILINE)


def run_page(page):
    """Do what a page says, in the present folder; the names that its programs leave."""
    names = {}
    for language, title, body in blocks_of(page):
        if title:
            Path(title).write_text(body)
        elif language == "python":
            exec(compile(body, page, "exec"), names)
        elif language == "sh":
            for command in body.replace("\\\n", " ").splitlines():
                program, *arguments = shlex.split(command)
                assert program == "morph"
                assert main(arguments) == 0, command
    return names


@pytest.mark.slow
def test_own_sheet():
    names = run_page("tutorials/sheet.md")
    assert names["figures"]["mean_mm"] < 0.3
    assert all(result.tracked for result in names["results"])
    assert json.loads(Path("run/summary.json").read_text())["n_tracked"] == 30


@pytest.mark.slow
def test_own_solid_in_a_scanned_scene():
    names = run_page("tutorials/solid.md")
    assert np.abs(names["error"]).mean() < 0.2e-3
    np.testing.assert_allclose(names["pushes"], names["found"], atol=0.1e-3)  # frame by frame as by the command


@pytest.mark.slow
def test_own_material_and_parameters():
    names = run_page("tutorials/material.md")
    assert names["model"].certificate["displacement"]["mean_relative_to_largest"] < 0.01


def test_results_in_a_notebook(tmp_path):
    scene = write_scene(tmp_path, top="frames = 5\n", tail=MOTION)
    assert main(["simulate", str(scene), "-o", "recording"]) == 0
    command = "track recording/frames --model sheet.morph --camera recording/camera.yaml --no-video"
    assert main(shlex.split(f"{command} --landmarks recording/landmarks.csv -o run")) == 0
    names = {}
    exec(compile((DOCS / "tutorials/results.py").read_text(), "results.py", "exec"), names)
    assert names["positions"].shape == names["model"].nodes.shape
    assert np.isfinite(names["path"]).all()
    assert {path.name for path in tmp_path.glob("*.png")} >= {"parameters.png", "stress.png", "field.png"}


def test_the_example_of_the_readme(tmp_path, capsys):
    """With a recording where `make demo` leaves one."""
    (tmp_path / "demo").mkdir()
    scene = write_scene(tmp_path / "demo", top="frames = 3\n", tail=MOTION)
    assert main(["simulate", str(scene), "-o", "demo/sequence"]) == 0
    for page in ("../README.md", "quick-start.md"):
        (program,) = (body for language, _, body in blocks_of(page) if language == "python")
        capsys.readouterr()
        exec(program, {})
        said = capsys.readouterr().out
        assert said.count("MPa") == 3, said


def test_extensions_of_one_file_each(tmp_path):
    """In an interpreter of its own, so that nothing stays registered."""
    program = ""
    for language, title, body in blocks_of("extending.md"):
        if title:
            Path(title).write_text(body)
        elif language == "python":
            program += body
    Path("program.py").write_text(f"{program}\nprint(force, error, *numbers)\n")
    done = subprocess.run([sys.executable, "program.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    force, error, *numbers = map(float, done.stdout.splitlines()[-1].split())
    # Tension of an incompressible bar, 20 x 20 mm, stretched by 1.2.
    growth = np.exp(1.5 * (1.2**2 + 2.0 / 1.2 - 3.0))
    assert abs(force) == pytest.approx(15e3 * growth * (1.2 - 1.2**-2) * 0.02**2, rel=0.03)
    assert error < 0.05
    assert numbers == [2.0, 3.0, 4.0]
