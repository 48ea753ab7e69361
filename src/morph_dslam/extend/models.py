"""What reduced models are made of: separated fields, functions of the parameters, points that a model carries."""

from morph_dslam.model import MaterialPoints, SeparatedField, SurfacePoints
from morph_dslam.model.basis_functions import Basis, chebyshev_basis, cubic_spline_basis, hat_basis
from morph_dslam.model.functions import Functions, ParameterFunctions, total_degree_indices
from morph_dslam.model.inner_structure import CarriedStructure, save_inner_structure
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.tensor_functions import CPFunctions

__all__ = [
    "Basis",
    "CPFunctions",
    "CarriedStructure",
    "Functions",
    "MaterialPoints",
    "ParameterFunctions",
    "SeparatedField",
    "SurfacePoints",
    "chebyshev_basis",
    "cubic_spline_basis",
    "hat_basis",
    "save_inner_structure",
    "total_degree_indices",
    "von_mises",
]
