"""morph-dslam: physics-based reduced models of deformable solids, tracked in video.

    import morph_dslam as md

Every public name is imported when it is first used, so that ``import morph_dslam`` alone is cheap. What those need
who extend the program (material laws, sources, reduction methods, building blocks) is in `morph_dslam.extend`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from morph_dslam._version import __version__ as __version__

__all__ = [
    "Board",
    "Camera",
    "Frame",
    "FrameResult",
    "MorphError",
    "Parameter",
    "ReducedModel",
    "Registration",
    "Run",
    "Scene",
    "Session",
    "SlamOptions",
    "SolidProblem",
    "StateChoice",
    "Status",
    "TrackOptions",
    "Tracker",
    "TrackerOptions",
    "TrackingWarning",
    "build",
    "calibrate",
    "evaluate",
    "evaluate_depth",
    "evaluate_trajectory",
    "explore",
    "export",
    "load_camera",
    "load_model",
    "load_registration",
    "load_run",
    "load_scene",
    "load_study",
    "make_study",
    "map_scene",
    "open_live",
    "open_source",
    "register",
    "register_board",
    "register_landmarks",
    "save_model",
    "simulate",
    "track",
    "write_build_report",
]
#: The module of each public name, as in the imports below.
_MODULES = {
    "Board": "calibration.board",
    "Camera": "camera",
    "Frame": "sources.frames",
    "FrameResult": "tracking.result",
    "MorphError": "errors",
    "Parameter": "model",
    "ReducedModel": "model",
    "Registration": "registration.registration",
    "Run": "evaluation.run_folder",
    "Scene": "slam.scene",
    "Session": "tracking.session",
    "SlamOptions": "slam.options",
    "SolidProblem": "mechanics.solid",
    "StateChoice": "io.export",
    "Status": "tracking.outcomes",
    "TrackOptions": "tracking.run_options",
    "Tracker": "tracking.tracker",
    "TrackerOptions": "tracking.options",
    "TrackingWarning": "tracking.outcomes",
    "build": "studies.build",
    "calibrate": "calibration.calibrate",
    "evaluate": "evaluation.evaluate",
    "evaluate_depth": "evaluation.evaluate",
    "evaluate_trajectory": "evaluation.trajectory",
    "explore": "explorer.server",
    "export": "io.export",
    "load_camera": "io.camera_files",
    "load_model": "model",
    "load_registration": "registration.registration",
    "load_run": "evaluation.run_folder",
    "load_scene": "slam.scene",
    "load_study": "studies.study",
    "make_study": "studies.study",
    "map_scene": "slam.scene",
    "open_live": "sources",
    "open_source": "sources",
    "register": "registration.register",
    "register_board": "registration.board_registration",
    "register_landmarks": "registration.landmarks",
    "save_model": "model",
    "simulate": "render.simulation",
    "track": "tracking.track",
    "write_build_report": "reduction.report",
}

if TYPE_CHECKING:  # the same for editors and type checkers
    from morph_dslam.calibration.board import Board
    from morph_dslam.calibration.calibrate import calibrate
    from morph_dslam.camera import Camera
    from morph_dslam.errors import MorphError
    from morph_dslam.evaluation.evaluate import evaluate, evaluate_depth
    from morph_dslam.evaluation.run_folder import Run, load_run
    from morph_dslam.evaluation.trajectory import evaluate_trajectory
    from morph_dslam.explorer.server import explore
    from morph_dslam.io.camera_files import load_camera
    from morph_dslam.io.export import StateChoice, export
    from morph_dslam.mechanics.solid import SolidProblem
    from morph_dslam.model import Parameter, ReducedModel, load_model, save_model
    from morph_dslam.reduction.report import write_build_report
    from morph_dslam.registration.board_registration import register_board
    from morph_dslam.registration.landmarks import register_landmarks
    from morph_dslam.registration.register import register
    from morph_dslam.registration.registration import Registration, load_registration
    from morph_dslam.render.simulation import simulate
    from morph_dslam.slam.options import SlamOptions
    from morph_dslam.slam.scene import Scene, load_scene, map_scene
    from morph_dslam.sources import open_live, open_source
    from morph_dslam.sources.frames import Frame
    from morph_dslam.studies.build import build
    from morph_dslam.studies.study import load_study, make_study
    from morph_dslam.tracking.options import TrackerOptions
    from morph_dslam.tracking.outcomes import Status, TrackingWarning
    from morph_dslam.tracking.result import FrameResult
    from morph_dslam.tracking.run_options import TrackOptions
    from morph_dslam.tracking.session import Session
    from morph_dslam.tracking.track import track
    from morph_dslam.tracking.tracker import Tracker


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'morph_dslam' has no attribute '{name}'")
    value = getattr(import_module(f"morph_dslam.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
