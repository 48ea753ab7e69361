"""The environment that other libraries are compared in, made when it is first needed.

They are no dependencies of the project, some for their licence: they live in .venv-bench beside an editable
install of the project (some hundred megabytes).
"""

from __future__ import annotations

import subprocess
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = ROOT / ".venv-bench"


def peer_python(package: str, requirement: str) -> Path:
    """The interpreter of the environment with a package, which is installed by its requirement if need be."""
    python = ENVIRONMENT / "bin" / "python"
    if not (ENVIRONMENT / "complete").is_file():
        print(f"making {ENVIRONMENT} (once)", flush=True)
        venv.create(ENVIRONMENT, with_pip=True, clear=True)
        _install(python, "--editable", f"{ROOT}[pardiso]")
        (ENVIRONMENT / "complete").touch()
    if subprocess.run([python, "-c", f"import {package}"], capture_output=True).returncode:
        print(f"installing {requirement} in {ENVIRONMENT} (once)", flush=True)
        _install(python, requirement)
    return python


def _install(python: Path, *wanted: str) -> None:
    subprocess.run([python, "-m", "pip", "install", "--quiet", *wanted], check=True)
