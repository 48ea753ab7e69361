"""One material of every law, with its stress in closed form."""

from __future__ import annotations

from functools import partial

import ngsolve as ngs
import numpy as np

from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden, Orthotropic, TransverselyIsotropic
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.materials.isotropic import (
    ArrudaBoyce,
    Gent,
    Hyperfoam,
    LinearElastic,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    StVenantKirchhoff,
    Yeoh,
)
from morph_dslam.mechanics.materials.user import UserMaterial
from tests.support import closed_form_stress as exact


def rotation(*angles):
    """Rotation by these angles about z, then y, then x."""
    Q = np.eye(3)
    for (i, j), angle in zip(((0, 1), (0, 2), (1, 2)), angles, strict=True):
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        Q = R @ Q
    return Q


AXES = rotation(0.4, -0.3, 0.8)
FIBRE, FIBRE_2 = np.array([0.6, 0.8, 0.0]), np.array([0.6, -0.64, 0.48])
MODULI, EXPONENTS = (0.4, -0.1, 0.05), (1.6, -2.2, 5.0)
ORTHO = {"e": (9.0, 4.0, 2.5), "n": (0.3, 0.25, 0.2), "g": (1.7, 1.2, 0.9)}
#: A deformation gradient without any symmetry.
BULGED = np.array([[1.3, 0.2, -0.1], [0.05, 0.85, 0.3], [0.15, -0.2, 1.1]])


def orthotropic(**changed):
    """The law with the constants of `ORTHO`, but for those that are given."""
    pairs = ("12", "13", "23")
    values = {f"young_{i}": e for i, e in zip("123", ORTHO["e"], strict=True)}
    values |= {f"poisson_{pair}": n for pair, n in zip(pairs, ORTHO["n"], strict=True)}
    values |= {f"shear_{pair}": g for pair, g in zip(pairs, ORTHO["g"], strict=True)}
    return Orthotropic(**(values | changed))


def user_energy(F, c10, c01):
    C, J = F.trans * F, ngs.Det(F)
    i2 = 0.5 * (ngs.Trace(C) ** 2 - ngs.InnerProduct(C, C))
    return c10 * (J ** (-2 / 3) * ngs.Trace(C) - 3.0) + c01 * (J ** (-4 / 3) * i2 - 3.0)


def fibre_moduli(along, across, n_along, n_across, g_along):
    """The law's lambda, mu, alpha, beta, gamma from the inverse of its compliance at small strain."""
    mu = across / (2.0 * (1.0 + n_across))
    c = exact.orthotropic_stiffness((along, across, across), (n_along, n_along, n_across), (g_along, g_along, mu))
    lam, alpha, beta = c[1, 2], mu - g_along, 0.5 * (c[0, 1] - c[1, 2])
    gamma = (c[0, 0] - lam - 2.0 * mu - 4.0 * beta + 4.0 * alpha) / 8.0
    return {"lam": lam, "mu": mu, "alpha": alpha, "beta": beta, "gamma": gamma}


_HOOKE = {"young": 3.0, "poisson": 0.3}
_MOONEY = {"c10": 0.3, "c01": 0.12, "bulk": 7.0}
_YEOH = {"c10": 0.4, "c20": -0.02, "c30": 0.004, "bulk": 7.0}
_GENT = {"shear": 0.8, "limit": 12.0, "bulk": 7.0}
_CHAINS = {"shear": 0.8, "limit": 2.5, "bulk": 7.0}
_HGO = {"shear": 0.5, "k1": 1.3, "k2": 0.7, "dispersion": 0.1, "bulk": 7.0}
#: name -> (material, closed form P(F)).
LAWS = {
    "neo_hookean": (NeoHookean(**_HOOKE), partial(exact.neo_hookean, **_HOOKE)),
    "st_venant_kirchhoff": (StVenantKirchhoff(**_HOOKE), partial(exact.st_venant_kirchhoff, **_HOOKE)),
    "linear_elastic": (LinearElastic(**_HOOKE), partial(exact.linear_elastic, **_HOOKE)),
    "mooney_rivlin": (MooneyRivlin(**_MOONEY), partial(exact.mooney_rivlin, **_MOONEY)),
    "yeoh": (Yeoh(**_YEOH), partial(exact.yeoh, **_YEOH)),
    "gent": (Gent(**_GENT), partial(exact.gent, **_GENT)),
    "arruda_boyce": (ArrudaBoyce(**_CHAINS), partial(exact.arruda_boyce, **_CHAINS)),
    "ogden": (
        Ogden(moduli=MODULI, exponents=EXPONENTS, bulk=7.0),
        partial(exact.ogden, moduli=MODULI, exponents=EXPONENTS, bulk=7.0),
    ),
    "hyperfoam": (
        Hyperfoam(moduli=(0.4, 0.1), exponents=(-2.0, 5.0), poissons=(0.25, 0.0)),
        partial(exact.hyperfoam, moduli=(0.4, 0.1), exponents=(-2.0, 5.0), poissons=(0.25, 0.0)),
    ),
    "orthotropic": (
        orthotropic(axis_1=tuple(AXES[:, 0]), axis_2=tuple(AXES[:, 1] + 0.3 * AXES[:, 0])),
        partial(exact.orthotropic, axes=AXES, **ORTHO),
    ),
    "transversely_isotropic": (
        TransverselyIsotropic(
            young_fibre=6.0, young_cross=2.0, poisson_fibre=0.3, poisson_cross=0.2, shear_fibre=1.1,
            fibre=tuple(FIBRE),
        ),
        partial(exact.transversely_isotropic, a=FIBRE, **fibre_moduli(6.0, 2.0, 0.3, 0.2, 1.1)),
    ),
    "holzapfel_gasser_ogden": (
        HolzapfelGasserOgden(**_HGO, fibre=tuple(FIBRE), fibre_2=tuple(FIBRE_2)),
        partial(exact.holzapfel_gasser_ogden, fibres=(FIBRE, FIBRE_2), **_HGO),
    ),
    "user_material": (
        UserMaterial(function=user_energy, values={"c10": 0.3, "c01": 0.12}, bulk=7.0),
        partial(exact.mooney_rivlin, **_MOONEY),
    ),
}  # fmt: skip


def tensor(F):
    """A constant 3x3 coefficient function."""
    return ngs.CF(tuple(np.asarray(F, dtype=float).ravel()), dims=(3, 3))


def energy(material, F):
    return evaluate(material.energy(tensor(F)))


def stress(material, F):
    return evaluate(material.first_piola_kirchhoff(tensor(F))).reshape(3, 3)


def tangent(material, F):
    """dP/dF (3, 3, 3, 3)."""
    F = tensor(F).MakeVariable()
    return evaluate(material.energy(F).Diff(F).Diff(F)).reshape(3, 3, 3, 3)


def tangent_by_differences(exact_stress, F, h=1e-5):
    """dP/dF (3, 3, 3, 3) of a closed form P(F), by central differences."""
    differences = np.zeros((3, 3, 3, 3))
    for i, j in np.ndindex(3, 3):
        d = np.zeros((3, 3))
        d[i, j] = h
        differences[:, :, i, j] = (exact_stress(F + d) - exact_stress(F - d)) / (2.0 * h)
    return differences
