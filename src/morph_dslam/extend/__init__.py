"""What those need who extend the program or build experiments of their own, beside the names of `morph_dslam`.

Here are what a command-line program needs, and the registries: a new law, source or method of reduction is one
file that registers it. Building blocks stand in a module for each subject:

=====================  ==============================================================================
`extend.calibration`   cameras that are fixed to each other
`extend.geometry`      rigid and similarity transforms, rotations
`extend.identification` constant parameters from measured points and forces
`extend.material_tests` laws fitted to stress-strain tables of tests
`extend.mechanics`     meshes, hyperelastic laws, supports, loads, and what solves a `SolidProblem`
`extend.models`        separated fields, functions of the parameters, points that a model carries
`extend.reduction`     methods that reduce solutions, and their certificate
`extend.registration`  landmarks, and registration in a map with its run folder
`extend.rendering`     drawing of models: rasteriser, overlays, pictures of states
`extend.reports`       the blocks of a report page, and the lines that sum up a run
`extend.sheets`        thin sheets and shells, and paths past buckling by arc length
`extend.slam`          tracking and mapping of a rigid scene, frame by frame
`extend.streams`       results for other programs, frame by frame
`extend.studies`       studies as objects, and their solved samples
`extend.tracking`      points bound to a model, and the estimator of parameters and pose
=====================  ==============================================================================
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

#: The module of each public name, as in the imports below; it is imported when the name is first used.
_MODULES = {
    "frame_range": "cli.arguments",
    "one_thread_for_algebra": "threads",
    "register_law": "mechanics.materials.base",
    "register_reduction": "reduction.registry",
    "register_source": "sources",
    "run_and_report_errors": "cli.app",
    "threads_side_by_side": "threads",
}
__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from morph_dslam.cli.app import run_and_report_errors as run_and_report_errors
    from morph_dslam.cli.arguments import frame_range as frame_range
    from morph_dslam.mechanics.materials.base import register_law as register_law
    from morph_dslam.reduction.registry import register_reduction as register_reduction
    from morph_dslam.sources import register_source as register_source
    from morph_dslam.threads import (
        one_thread_for_algebra as one_thread_for_algebra,
        threads_side_by_side as threads_side_by_side,
    )


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'morph_dslam.extend' has no attribute '{name}'")
    return getattr(import_module(f"morph_dslam.{_MODULES[name]}"), name)
