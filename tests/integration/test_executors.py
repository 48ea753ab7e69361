"""Builds of scripts, each a process of its own: without a main guard, with laws of their own, on forked workers."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from morph_dslam.cli.app import main
from morph_dslam.mechanics.materials import base
from morph_dslam.mechanics.materials.base import registered_laws
from morph_dslam.mechanics.materials.library import laws
from morph_dslam.studies.executors import default_executor
from tests.support.block_study import write_study

LAW = '''
import ngsolve as ngs
from morph_dslam.extend import register_law
from morph_dslam.extend.mechanics import Rubber, first_invariant


@register_law("softened")
class Softened(Rubber):
    """A neo-Hookean law under another name."""

    def distortional(self, F, J):
        return 0.5 * self.mu * (first_invariant(F, J) - 3.0)

    mu: object
'''
BUILD = 'md.build("study.toml", "block.morph", workers=2)\n'
FORKED = """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
import morph_dslam as md

with ProcessPoolExecutor(1, mp_context=get_context("fork")) as executor:
    md.build("study.toml", "block.morph", executor=executor)
"""
SOFTENED = ('law = "neo_hookean"\nyoung = "young"\npoisson = 0.3', 'law = "softened"\nmu = "young"\nbulk = "4 MPa"')


def run(folder: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a folder."""
    (folder / "script.py").write_text(script)
    command = [sys.executable, "script.py"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> bytes:
    """The model file of a build in one process."""
    folder = tmp_path_factory.mktemp("expected")
    assert main(["build", str(write_study(folder)), "-o", str(folder / "block.morph")]) == 0
    return (folder / "block.morph").read_bytes()


@pytest.mark.slow
def test_a_script_needs_no_main_guard(expected: bytes, tmp_path: Path) -> None:
    write_study(tmp_path)
    ended = run(tmp_path, f'import morph_dslam as md\nprint("run")\n{BUILD}')
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == "run\n"  # by no worker
    assert (tmp_path / "block.morph").read_bytes() == expected


@pytest.mark.slow
def test_workers_know_the_laws_of_files_that_a_script_imports(tmp_path: Path) -> None:
    write_study(tmp_path, SOFTENED)
    (tmp_path / "softened.py").write_text(LAW)
    ended = run(tmp_path, f"import morph_dslam as md\nimport softened\n{BUILD}")
    assert ended.returncode == 0, ended.stderr


@pytest.fixture
def quick_law(tmp_path: Path) -> Iterator[type]:
    """A law of an imported file; what is registered and imported is as before afterwards."""
    (tmp_path / "quick_law.py").write_text(LAW.replace("softened", "quickly softened"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "_LAWS", dict(laws()))
        patch.syspath_prepend(tmp_path)
        yield import_module("quick_law").Softened
    del sys.modules["quick_law"]


def test_a_worker_knows_a_law_that_this_process_has_imported(quick_law: type) -> None:
    with default_executor(2) as executor:
        assert executor.submit(registered_laws).result()["quickly softened"] is quick_law


@pytest.mark.slow
def test_workers_know_the_laws_of_a_script_with_a_main_guard(tmp_path: Path) -> None:
    write_study(tmp_path, SOFTENED)
    ended = run(tmp_path, f'{LAW}\nimport morph_dslam as md\nif __name__ == "__main__":\n    {BUILD}')
    assert ended.returncode == 0, ended.stderr


@pytest.mark.slow
def test_a_script_whose_own_laws_need_a_main_guard_is_told_so(tmp_path: Path) -> None:
    write_study(tmp_path, SOFTENED)
    ended = run(tmp_path, f"{LAW}\nimport morph_dslam as md\n{BUILD}")
    assert ended.returncode == 1
    said = ended.stderr.splitlines()[-1]
    assert "WorkerError" in said
    assert 'if __name__ == "__main__":' in said
    assert not (tmp_path / "block.morph").exists()


@pytest.mark.slow
def test_forked_workers_do_not_keep_the_folder_locked(tmp_path: Path) -> None:
    """They inherit what is open in the main process; the held-out samples are solved in a sweep of their own."""
    write_study(tmp_path, ('method = "pod"\nmax_degree = 2\n', 'method = "galerkin"\n'))
    ended = run(tmp_path, FORKED)
    assert ended.returncode == 0, ended.stderr


def test_a_process_held_to_one_core_takes_one(tmp_path: Path) -> None:
    # As a cluster's job or a container is held to some of its machine's cores.
    script = """
import os
from morph_dslam.threads import usable_cores

everything = os.sched_getaffinity(0)
assert 1 <= usable_cores() <= len(everything)
os.sched_setaffinity(0, {min(everything)})
print(usable_cores())
"""
    assert run(tmp_path, script).stdout == "1\n"
