"""Meshes, laws, supports, loads, couplings and contacts of a `morph_dslam.SolidProblem`, and what solves it."""

from morph_dslam.mechanics.contact import (
    RigidCylinder as RigidCylinder,
    RigidPlane as RigidPlane,
    RigidSphere as RigidSphere,
    SurfaceContact as SurfaceContact,
)
from morph_dslam.mechanics.coupled_solid import CoupledSolid as CoupledSolid
from morph_dslam.mechanics.couplings import Coupling as Coupling
from morph_dslam.mechanics.loads import (
    BodyForce as BodyForce,
    DeadTraction as DeadTraction,
    FollowerPressure as FollowerPressure,
    Gravity as Gravity,
    MovingLine as MovingLine,
    MovingPatch as MovingPatch,
    NodalForces as NodalForces,
    PointLoad as PointLoad,
    SurfaceForce as SurfaceForce,
)
from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden as HolzapfelGasserOgden
from morph_dslam.mechanics.materials.base import (
    Constant as Constant,
    Material as Material,
    green_lagrange as green_lagrange,
    log_volume as log_volume,
    right_cauchy_green as right_cauchy_green,
)
from morph_dslam.mechanics.materials.catalogue import (
    CataloguedMaterial as CataloguedMaterial,
    material_catalogue as material_catalogue,
)
from morph_dslam.mechanics.materials.isotropic import (
    ArrudaBoyce as ArrudaBoyce,
    Gent as Gent,
    Hyperfoam as Hyperfoam,
    LinearElastic as LinearElastic,
    MooneyRivlin as MooneyRivlin,
    NeoHookean as NeoHookean,
    Ogden as Ogden,
    Rubber as Rubber,
    StVenantKirchhoff as StVenantKirchhoff,
    Yeoh as Yeoh,
    first_invariant as first_invariant,
    second_invariant as second_invariant,
)
from morph_dslam.mechanics.materials.library import constant_quantities as constant_quantities, laws as laws
from morph_dslam.mechanics.materials.viscoelastic import Prony as Prony
from morph_dslam.mechanics.parameters import ParameterSymbols as ParameterSymbols
from morph_dslam.mechanics.rigid_mesh import RigidMesh as RigidMesh
from morph_dslam.mechanics.solid import SolidOptions as SolidOptions
from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning as NearlyIncompressibleWarning
from morph_dslam.mechanics.solvers.arc_length import (
    ArcLength as ArcLength,
    ArcOptions as ArcOptions,
    missed_bifurcations as missed_bifurcations,
)
from morph_dslam.mechanics.solvers.buckling import buckling_modes as buckling_modes
from morph_dslam.mechanics.solvers.continuation import advance as advance, loaded_state as loaded_state
from morph_dslam.mechanics.solvers.newton import State as State, sensitivities as sensitivities, solve as solve
from morph_dslam.mechanics.supports import (
    ElasticFoundation as ElasticFoundation,
    PrescribedDisplacement as PrescribedDisplacement,
    RigidRotation as RigidRotation,
    fixed as fixed,
)
from morph_dslam.meshing.extrusion import Hole as Hole, extrusion as extrusion
from morph_dslam.meshing.generators import Profile as Profile, block as block, revolution as revolution, tube as tube
from morph_dslam.meshing.inp_writing import save_mesh as save_mesh
from morph_dslam.meshing.mesh_checks import check_mesh as check_mesh
from morph_dslam.meshing.mesh_files import load_mesh as load_mesh
from morph_dslam.meshing.mesh_summary import (
    SET_COLUMNS as SET_COLUMNS,
    described_mesh as described_mesh,
    set_rows as set_rows,
)
from morph_dslam.meshing.meshes import CellBlock as CellBlock, Mesh as Mesh, model_mesh_of as model_mesh_of
from morph_dslam.meshing.second_order import to_second_order as to_second_order
