"""Materials from the cards of an Abaqus or CalculiX input file.

Abaqus's conventions are kept: the constants of a viscoelastic material are the long-term ones unless its card
says MODULI=INSTANTANEOUS, and D1 = 2/kappa. D1 = 0, full incompressibility, becomes a Poisson's ratio of
0.4999.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.io.inp_materials import Constants, MaterialCard
from morph_dslam.offline.materials.anisotropic import Orthotropic
from morph_dslam.offline.materials.base import Material
from morph_dslam.offline.materials.isotropic import StVenantKirchhoff
from morph_dslam.offline.materials.ogden import Ogden
from morph_dslam.offline.materials.rubber import MooneyRivlin, Yeoh
from morph_dslam.offline.materials.viscoelastic import Prony

#: Poisson's ratio that stands for full incompressibility.
INCOMPRESSIBLE = 0.4999
#: Stress (Pa) and density (kg/m3) of the unit systems that go with a length, both in newton and second.
CONSISTENT_UNITS = {"m": (1.0, 1.0), "mm": (1.0e6, 1.0e12)}


def material_from_card(card: MaterialCard, length_unit: str) -> Material:
    """The material of a card, in SI.

    *ELASTIC becomes the St Venant-Kirchhoff law or its orthotropic form, so that parts may turn.

    Parameters
    ----------
    card : what the file says.
    length_unit : "mm" (stresses in MPa, densities in t/mm3) or "m" (Pa, kg/m3).

    Raises
    ------
    StudyError : no elastic constants, other units, or a law that has no counterpart here.
    """
    if length_unit not in CONSISTENT_UNITS:
        raise StudyError(
            f"material cards are read in mm (with MPa) or m (with Pa), not in {length_unit}; "
            "give the material in the study instead"
        )
    stress, density = CONSISTENT_UNITS[length_unit]
    common: dict[str, Any] = {"density": (card.density or 0.0) * density, "prony": _prony(card)}
    constants = card.hyperelastic or card.elastic
    if constants is None:
        raise card.line.error(f"material {card.name} has neither *ELASTIC nor *HYPERELASTIC")
    long_term = card.prony and not constants.instantaneous
    g, k = (sum(row[i] for row in card.prony) if long_term else 0.0 for i in (0, 1))
    if not max(g, k) < 1.0:
        raise card.line.error(f"material {card.name}: its Prony moduli must sum to less than 1")
    shear = stress / (1.0 - g)
    if card.hyperelastic is not None:
        return _hyperelastic(card.hyperelastic, shear, stress / (1.0 - k), common)
    if any(row[0] != row[1] for row in card.prony):
        raise card.line.error(
            f"material {card.name}: a Prony series over *ELASTIC must have k = g in every term; "
            "use *HYPERELASTIC for a bulk modulus that relaxes otherwise"
        )
    return _elastic(constants, shear, common)


def _prony(card: MaterialCard) -> Prony | None:
    if not card.prony:
        return None
    g, k, times = zip(*card.prony, strict=True)
    return Prony(g, times, k)


def _bulk(values: dict[str, float], shear_modulus: float, unit: float) -> float:
    """Bulk modulus, Pa, from D1 (1/unit); higher terms of the volumetric energy have no counterpart."""
    if any(value != 0.0 for name, value in values.items() if name[0] == "D" and name != "D1"):
        raise StudyError("*HYPERELASTIC with D2, D3, ... other than 0 is not supported; keep D1 alone")
    if values["D1"] == 0.0:
        return shear_modulus * 2.0 * (1.0 + INCOMPRESSIBLE) / (3.0 * (1.0 - 2.0 * INCOMPRESSIBLE))
    return 2.0 / values["D1"] * unit


def _hyperelastic(card: Constants, shear: float, bulk: float, common: dict[str, Any]) -> Material:
    values = card.values
    if card.law == "OGDEN":
        n = len(values) // 3
        moduli = tuple(shear * values[f"mu{i}"] for i in range(1, n + 1))
        exponents = tuple(values[f"alpha{i}"] for i in range(1, n + 1))
        kappa = _bulk(values, sum(moduli), bulk)
        return Ogden(moduli=moduli, exponents=exponents, bulk=kappa, **common)
    c10 = shear * values["C10"]
    if card.law == "YEOH":
        kappa = _bulk(values, 2.0 * c10, bulk)
        return Yeoh(c10=c10, c20=shear * values["C20"], c30=shear * values["C30"], bulk=kappa, **common)
    c01 = shear * values.get("C01", 0.0)
    return MooneyRivlin(c10=c10, c01=c01, bulk=_bulk(values, 2.0 * (c10 + c01), bulk), **common)


def _elastic(card: Constants, unit: float, common: dict[str, Any]) -> Material:
    v = card.values
    if card.law == "ISOTROPIC":
        return StVenantKirchhoff(young=unit * v["E"], poisson=v["nu"], **common)
    if card.law == "ORTHOTROPIC":
        v = _engineering_constants(v)
    return Orthotropic(
        young_1=unit * v["E1"], young_2=unit * v["E2"], young_3=unit * v["E3"],
        poisson_12=v["nu12"], poisson_13=v["nu13"], poisson_23=v["nu23"],
        shear_12=unit * v["G12"], shear_13=unit * v["G13"], shear_23=unit * v["G23"],
        **common,
    )  # fmt: skip


def _engineering_constants(d: dict[str, float]) -> dict[str, float]:
    """Engineering constants from the stiffnesses D of TYPE=ORTHOTROPIC."""
    normal = np.array(
        [
            [d["D1111"], d["D1122"], d["D1133"]],
            [d["D1122"], d["D2222"], d["D2233"]],
            [d["D1133"], d["D2233"], d["D3333"]],
        ]
    )
    if not np.linalg.eigvalsh(normal)[0] > 0.0:
        raise StudyError("*ELASTIC, TYPE=ORTHOTROPIC is unstable: its normal stiffnesses are not positive")
    s = np.linalg.inv(normal)
    return {
        "E1": 1.0 / s[0, 0], "E2": 1.0 / s[1, 1], "E3": 1.0 / s[2, 2],
        "nu12": -s[0, 1] / s[0, 0], "nu13": -s[0, 2] / s[0, 0], "nu23": -s[1, 2] / s[1, 1],
        "G12": d["D1212"], "G13": d["D1313"], "G23": d["D2323"],
    }  # fmt: skip
