"""Studies as objects, their solved samples, and what solves and reads them."""

from morph_dslam.meshing.mesh_notes import file_notes as file_notes
from morph_dslam.meshing.surface_repair import repairs_in_words as repairs_in_words
from morph_dslam.studies.build import build_warnings as build_warnings
from morph_dslam.studies.executors import default_executor as default_executor
from morph_dslam.studies.inner_structures import (
    described_inner as described_inner,
    inner_size_note as inner_size_note,
    place_inner_structure as place_inner_structure,
    read_inner_structure as read_inner_structure,
)
from morph_dslam.studies.problem import ModelMesh as ModelMesh, Snapshot as Snapshot
from morph_dslam.studies.provenance import study_warnings as study_warnings
from morph_dslam.studies.rigid import build_rigid as build_rigid
from morph_dslam.studies.sampling import held_out_samples as held_out_samples, training_samples as training_samples
from morph_dslam.studies.snapshots import (
    SOLVER_VERSION as SOLVER_VERSION,
    load_snapshot as load_snapshot,
    save_snapshot as save_snapshot,
    snapshot_key as snapshot_key,
)
from morph_dslam.studies.solid_study import SolidStudy as SolidStudy
from morph_dslam.studies.study import Study as Study, mesh_notes as mesh_notes, mesh_of_file as mesh_of_file
from morph_dslam.studies.sweep import run_sweep as run_sweep
