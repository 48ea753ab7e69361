"""Transforms of three-dimensional space."""

from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, fit_similarity, rotation_exp

__all__ = ["RigidTransform", "SimilarityTransform", "cross_matrix", "fit_similarity", "rotation_exp"]
