"""First Piola-Kirchhoff stress of every law, in numpy, from the literature's closed forms."""

from __future__ import annotations

import numpy as np


def invariants(F):
    C = F.T @ F
    i1 = np.trace(C)
    return C, i1, 0.5 * (i1**2 - np.trace(C @ C)), np.linalg.det(F)


def volumetric(F, bulk):
    J = np.linalg.det(F)
    return bulk * (J - 1.0) * J * np.linalg.inv(F).T


def from_invariants(F, w1, w2):
    """P of a law with slopes w1, w2 in the volume-preserving invariants."""
    C, i1, i2, J = invariants(F)
    inverse = np.linalg.inv(F).T
    return 2.0 * w1 * J ** (-2 / 3) * (F - i1 / 3.0 * inverse) + 2.0 * w2 * J ** (-4 / 3) * (
        i1 * F - F @ C - 2.0 / 3.0 * i2 * inverse
    )


def lame(young, poisson):
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def neo_hookean(F, young, poisson):
    lam, mu = lame(young, poisson)
    inverse = np.linalg.inv(F).T
    return mu * (F - inverse) + lam * np.log(np.linalg.det(F)) * inverse


def st_venant_kirchhoff(F, young, poisson):
    lam, mu = lame(young, poisson)
    E = 0.5 * (F.T @ F - np.eye(3))
    return F @ (2.0 * mu * E + lam * np.trace(E) * np.eye(3))


def linear_elastic(F, young, poisson):
    lam, mu = lame(young, poisson)
    e = 0.5 * (F + F.T) - np.eye(3)
    return 2.0 * mu * e + lam * np.trace(e) * np.eye(3)


def mooney_rivlin(F, c10, c01, bulk):
    return from_invariants(F, c10, c01) + volumetric(F, bulk)


def yeoh(F, c10, c20, c30, bulk):
    _, i1, _, J = invariants(F)
    x = J ** (-2 / 3) * i1 - 3.0
    return from_invariants(F, c10 + 2 * c20 * x + 3 * c30 * x**2, 0.0) + volumetric(F, bulk)


def gent(F, shear, limit, bulk):
    _, i1, _, J = invariants(F)
    x = J ** (-2 / 3) * i1 - 3.0
    return from_invariants(F, 0.5 * shear * limit / (limit - x), 0.0) + volumetric(F, bulk)


def arruda_boyce(F, shear, limit, bulk):
    _, i1, _, J = invariants(F)
    x = J ** (-2 / 3) * i1 / limit**2
    series = 1 / 2 + x / 10 + 11 * x**2 / 350 + 19 * x**3 / 1750 + 519 * x**4 / 134750
    return from_invariants(F, shear * series, 0.0) + volumetric(F, bulk)


def ogden(F, moduli, exponents, bulk):
    """By principal stretches; an orthonormal basis exists where they are equal too."""
    squares, axes = np.linalg.eigh(F.T @ F)
    bar = np.sqrt(squares) * np.linalg.det(F) ** (-1 / 3)
    beta = sum(2 * m / a * (bar**a - np.mean(bar**a)) for m, a in zip(moduli, exponents, strict=True))
    return F @ (axes * (beta / squares)) @ axes.T + volumetric(F, bulk)


def hyperfoam(F, moduli, exponents, poissons):
    """By principal stretches, as `ogden`."""
    squares, axes = np.linalg.eigh(F.T @ F)
    stretches, J = np.sqrt(squares), np.linalg.det(F)
    terms = zip(moduli, exponents, poissons, strict=True)
    beta = sum(2 * m / a * (stretches**a - J ** (-a * n / (1 - 2 * n))) for m, a, n in terms)
    return F @ (axes * (beta / squares)) @ axes.T


def orthotropic_stiffness(e, n, g):
    """(6, 6) in Voigt's order 11, 22, 33, 23, 13, 12 from e_1..3, n_12, n_13, n_23 and g_12, g_13, g_23."""
    compliance = np.zeros((6, 6))
    compliance[:3, :3] = [
        [1 / e[0], -n[0] / e[0], -n[1] / e[0]],
        [-n[0] / e[0], 1 / e[1], -n[2] / e[1]],
        [-n[1] / e[0], -n[2] / e[1], 1 / e[2]],
    ]
    compliance[3:, 3:] = np.diag([1 / g[2], 1 / g[1], 1 / g[0]])
    return np.linalg.inv(compliance)


def orthotropic(F, axes, e, n, g):
    """``axes``: columns are the material axes."""
    E = axes.T @ (0.5 * (F.T @ F - np.eye(3))) @ axes
    strain = np.array([E[0, 0], E[1, 1], E[2, 2], 2 * E[1, 2], 2 * E[0, 2], 2 * E[0, 1]])
    s = orthotropic_stiffness(e, n, g) @ strain
    S = np.array([[s[0], s[5], s[4]], [s[5], s[1], s[3]], [s[4], s[3], s[2]]])
    return F @ axes @ S @ axes.T


def transversely_isotropic(F, a, lam, mu, alpha, beta, gamma):
    """Form of Bonet and Burton 1998."""
    C, _, _, J = invariants(F)
    inverse, stretched = np.linalg.inv(C), C @ a
    i4 = a @ stretched - 1.0
    S = mu * (np.eye(3) - inverse) + (lam * np.log(J) + beta * i4) * inverse
    S = S + 2.0 * (alpha + beta * np.log(J) + 2.0 * gamma * i4) * np.outer(a, a)
    return F @ (S - alpha * (np.outer(a, stretched) + np.outer(stretched, a)))


def holzapfel_gasser_ogden(F, fibres, shear, k1, k2, dispersion, bulk):
    P = from_invariants(F, 0.5 * shear, 0.0) + volumetric(F, bulk)
    for a in fibres:
        structure = dispersion * np.eye(3) + (1 - 3 * dispersion) * np.outer(a, a)
        E = max(np.sum(structure * (F.T @ F)) - 1.0, 0.0)
        P = P + 2.0 * k1 * E * np.exp(k2 * E**2) * F @ structure
    return P
