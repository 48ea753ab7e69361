"""The reduced model: what the offline part writes and the online part reads."""

from morph_dslam.model.parameters import Parameter
from morph_dslam.model.reduced_model import MaterialPoints, ReducedModel, SurfacePoints
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.storage import load_model, save_model

__all__ = ["MaterialPoints", "Parameter", "ReducedModel", "SeparatedField", "SurfacePoints", "load_model", "save_model"]
