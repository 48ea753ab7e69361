"""Strain energy of the bar's silicone, with its softness as the constant that is sought."""

from __future__ import annotations

from typing import Any

import ngsolve as ngs

#: Published with the recording: shear modulus, Pa.
PUBLISHED_SHEAR = 50.1e3


def neo_hookean(F: Any, softness: Any) -> Any:
    """Neo-Hookean energy without its volumetric part, Pa.

    W = mu/2 (tr F'F - 3 - 2 ln det F), mu = `PUBLISHED_SHEAR` / ``softness`` (Bonet and Wood, Nonlinear
    Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, section 6.4.3). A body under its own weight
    bends about in proportion to its softness, so it is the better parameter of the two.
    """
    shear = PUBLISHED_SHEAR / softness
    return 0.5 * shear * (ngs.InnerProduct(F, F) - 3.0 - 2.0 * ngs.log(ngs.Det(F)))
