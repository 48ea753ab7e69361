"""Studies as objects, their solved samples, and what solves and reads them."""

from morph_dslam.studies.build import build_warnings
from morph_dslam.studies.executors import default_executor
from morph_dslam.studies.inner_structures import place_inner_structure, read_inner_structure
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sampling import held_out_samples, training_samples
from morph_dslam.studies.snapshots import SOLVER_VERSION, load_snapshot, save_snapshot, snapshot_key
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import Study
from morph_dslam.studies.sweep import run_sweep

__all__ = [
    "SOLVER_VERSION",
    "ModelMesh",
    "Snapshot",
    "SolidStudy",
    "Study",
    "build_warnings",
    "default_executor",
    "held_out_samples",
    "load_snapshot",
    "place_inner_structure",
    "read_inner_structure",
    "run_sweep",
    "save_snapshot",
    "snapshot_key",
    "training_samples",
]
