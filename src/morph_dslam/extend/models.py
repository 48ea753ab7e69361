"""What reduced models are made of: separated fields, functions, points that a model carries; and what a file is."""

from morph_dslam.io.file_kinds import MESHES as MESHES, file_kind as file_kind
from morph_dslam.io.writing import check_no_input as check_no_input
from morph_dslam.model import (
    MaterialPoints as MaterialPoints,
    SeparatedField as SeparatedField,
    SurfacePoints as SurfacePoints,
)
from morph_dslam.model.basis_functions import (
    Basis as Basis,
    chebyshev_basis as chebyshev_basis,
    cubic_spline_basis as cubic_spline_basis,
    hat_basis as hat_basis,
)
from morph_dslam.model.functions import (
    Functions as Functions,
    ParameterFunctions as ParameterFunctions,
    total_degree_indices as total_degree_indices,
)
from morph_dslam.model.inner_structure import (
    CarriedStructure as CarriedStructure,
    save_inner_structure as save_inner_structure,
)
from morph_dslam.model.reduced_model import spread_over as spread_over, von_mises as von_mises
from morph_dslam.model.shown_field import ShownKind as ShownKind, shown_kind as shown_kind
from morph_dslam.model.tensor_functions import CPFunctions as CPFunctions
from morph_dslam.model.unknown_loads import with_unknown_loads as with_unknown_loads
