"""morph-dslam: physics-based reduced models of deformable solids, tracked in video.

    import morph_dslam as md

Every public name is imported when it is first used, so that ``import morph_dslam`` alone is cheap. What those need
who extend the program (material laws, sources, reduction methods, building blocks) is in `morph_dslam.extend`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from morph_dslam._version import __version__ as __version__
from morph_dslam.compiled_code import find_folder

find_folder()

#: The module of each public name, as in the imports below; it is imported when the name is first used.
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
    "SimulatedSequence": "render.simulation",
    "SlamOptions": "slam.options",
    "SolidProblem": "mechanics.solid",
    "StateChoice": "io.state_choice",
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
    "load_registration": "registration.registration_file",
    "load_run": "evaluation.run_folder",
    "load_scene": "slam.scene",
    "load_study": "studies.study",
    "make_study": "studies.study",
    "map_scene": "slam.scene",
    "open_live": "sources",
    "open_source": "sources",
    "open_studio": "studio.server",
    "register": "registration.register",
    "register_board": "registration.board_registration",
    "register_landmarks": "registration.landmarks",
    "save_model": "model",
    "simulate": "render.simulation",
    "track": "tracking.track",
    "write_build_report": "reduction.report",
}
__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:  # the same for editors and type checkers
    from morph_dslam.calibration.board import Board as Board
    from morph_dslam.calibration.calibrate import calibrate as calibrate
    from morph_dslam.camera import Camera as Camera
    from morph_dslam.errors import MorphError as MorphError
    from morph_dslam.evaluation.evaluate import evaluate as evaluate, evaluate_depth as evaluate_depth
    from morph_dslam.evaluation.run_folder import Run as Run, load_run as load_run
    from morph_dslam.evaluation.trajectory import evaluate_trajectory as evaluate_trajectory
    from morph_dslam.explorer.server import explore as explore
    from morph_dslam.io.camera_files import load_camera as load_camera
    from morph_dslam.io.export import export as export
    from morph_dslam.io.state_choice import StateChoice as StateChoice
    from morph_dslam.mechanics.solid import SolidProblem as SolidProblem
    from morph_dslam.model import (
        Parameter as Parameter,
        ReducedModel as ReducedModel,
        load_model as load_model,
        save_model as save_model,
    )
    from morph_dslam.reduction.report import write_build_report as write_build_report
    from morph_dslam.registration.board_registration import register_board as register_board
    from morph_dslam.registration.landmarks import register_landmarks as register_landmarks
    from morph_dslam.registration.register import register as register
    from morph_dslam.registration.registration import Registration as Registration
    from morph_dslam.registration.registration_file import load_registration as load_registration
    from morph_dslam.render.simulation import SimulatedSequence as SimulatedSequence, simulate as simulate
    from morph_dslam.slam.options import SlamOptions as SlamOptions
    from morph_dslam.slam.scene import Scene as Scene, load_scene as load_scene, map_scene as map_scene
    from morph_dslam.sources import open_live as open_live, open_source as open_source
    from morph_dslam.sources.frames import Frame as Frame
    from morph_dslam.studies.build import build as build
    from morph_dslam.studies.study import load_study as load_study, make_study as make_study
    from morph_dslam.studio.server import open_studio as open_studio
    from morph_dslam.tracking.options import TrackerOptions as TrackerOptions
    from morph_dslam.tracking.outcomes import Status as Status, TrackingWarning as TrackingWarning
    from morph_dslam.tracking.result import FrameResult as FrameResult
    from morph_dslam.tracking.run_options import TrackOptions as TrackOptions
    from morph_dslam.tracking.session import Session as Session
    from morph_dslam.tracking.track import track as track
    from morph_dslam.tracking.tracker import Tracker as Tracker


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'morph_dslam' has no attribute '{name}'")
    value = getattr(import_module(f"morph_dslam.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
