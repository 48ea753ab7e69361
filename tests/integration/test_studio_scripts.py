"""The scripts of the studio's pages, run by node with as much of a browser as they ask for."""

import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import pytest

SUPPORT = Path(__file__).parents[1] / "support" / "pages"
NODE = shutil.which("node")


@pytest.mark.skipif(NODE is None, reason="node runs the scripts of pages, and is not here")
def test_the_scripts_of_the_pages(tmp_path):
    for script in files("morph_dslam.studio").joinpath("static").iterdir():
        if script.name.endswith(".js"):
            (tmp_path / script.name).write_bytes(script.read_bytes())
    (tmp_path / "package.json").write_text('{"type": "module"}')
    for name in ("mesh_view.js", "solid_view.js"):
        shutil.copy(SUPPORT / "views.mjs", tmp_path / name)
    for name in ("dom.mjs", "pages.test.mjs"):
        shutil.copy(SUPPORT / name, tmp_path)
    run = subprocess.run(
        [NODE, "--test", "--test-reporter=tap", "pages.test.mjs"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode == 0, run.stdout
    assert "# pass" in run.stdout
