"""The distributed package holds all of the source: hatchling leaves out what git is told to ignore."""

import shutil
import subprocess
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]


@pytest.mark.skipif(shutil.which("git") is None or not (PROJECT / ".git").exists(), reason="this is no git checkout")
def test_no_file_of_the_project_is_ignored():
    """`runs/` in .gitignore, without a slash before it, once left `online/runs` out of the wheel."""
    command = ["git", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    found = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True)
    assert found.stdout == ""
    ignored = ["git", "check-ignore", "--no-index", "demo/report.html"]
    assert subprocess.run(ignored, cwd=PROJECT, capture_output=True, check=False).returncode == 0
