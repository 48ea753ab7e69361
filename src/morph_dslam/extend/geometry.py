"""Transforms of three-dimensional space."""

from morph_dslam.geometry import (
    RigidTransform as RigidTransform,
    SimilarityTransform as SimilarityTransform,
    cross_matrix as cross_matrix,
    fit_similarity as fit_similarity,
    rotation_exp as rotation_exp,
)
