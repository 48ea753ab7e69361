"""Meshes, hyperelastic laws, supports and loads of a `morph_dslam.SolidProblem`, and what solves it."""

from morph_dslam.mechanics.loads import (
    BodyForce,
    DeadTraction,
    FollowerPressure,
    Gravity,
    MovingLine,
    MovingPatch,
    NodalForces,
    PointLoad,
)
from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden
from morph_dslam.mechanics.materials.base import Constant, Material, green_lagrange, log_volume, right_cauchy_green
from morph_dslam.mechanics.materials.isotropic import (
    Gent,
    LinearElastic,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Rubber,
    StVenantKirchhoff,
    Yeoh,
    first_invariant,
    second_invariant,
)
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidOptions
from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.newton import State, sensitivities, solve
from morph_dslam.mechanics.supports import ElasticFoundation, PrescribedDisplacement, RigidRotation, fixed
from morph_dslam.meshing.generators import Profile, block, revolution, tube
from morph_dslam.meshing.mesh_checks import check_mesh
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.meshing.meshes import CellBlock, Mesh, model_mesh_of
from morph_dslam.meshing.second_order import to_second_order

__all__ = [
    "BodyForce",
    "CellBlock",
    "Constant",
    "DeadTraction",
    "ElasticFoundation",
    "FollowerPressure",
    "Gent",
    "Gravity",
    "HolzapfelGasserOgden",
    "LinearElastic",
    "Material",
    "Mesh",
    "MooneyRivlin",
    "MovingLine",
    "MovingPatch",
    "NearlyIncompressibleWarning",
    "NeoHookean",
    "NodalForces",
    "Ogden",
    "ParameterSymbols",
    "PointLoad",
    "PrescribedDisplacement",
    "Profile",
    "Prony",
    "RigidRotation",
    "Rubber",
    "SolidOptions",
    "StVenantKirchhoff",
    "State",
    "Yeoh",
    "advance",
    "block",
    "check_mesh",
    "first_invariant",
    "fixed",
    "green_lagrange",
    "load_mesh",
    "log_volume",
    "model_mesh_of",
    "revolution",
    "right_cauchy_green",
    "second_invariant",
    "sensitivities",
    "solve",
    "to_second_order",
    "tube",
]
