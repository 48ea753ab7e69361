"""morph-dslam: physics-based reduced models tracked in video.

from morph_dslam import build, load_model, load_study, make_study, save_model
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

#: Where each public name is; loaded when first asked for, so that the command line answers at once.
_PUBLIC = {
    "build": "morph_dslam.studies.build",
    "load_study": "morph_dslam.studies.study",
    "make_study": "morph_dslam.studies.study",
    "load_model": "morph_dslam.model",
    "save_model": "morph_dslam.model",
}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'morph_dslam' has no attribute '{name}'")
