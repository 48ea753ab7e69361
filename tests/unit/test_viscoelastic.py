"""Prony series: relaxation of elements in closed form, internal variables that can be restored, checks."""

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.materials.viscoelastic import Prony
from tests.support import closed_form_stress as exact
from tests.support.material_laws import BULGED as F_HELD
from tests.support.solids import PrescribedCells

ELASTIC = NeoHookean(young=3.0, poisson=0.3)
MATERIAL = NeoHookean(young=3.0, poisson=0.3, prony=Prony((0.3, 0.2), (0.5, 4.0), (0.0, 0.0)))


def split_stress(F):
    """P of the remainder and of the volumetric part of MATERIAL."""
    lam, _ = exact.lame(3.0, 0.3)
    volumetric = lam * np.log(np.linalg.det(F)) * np.linalg.inv(F).T
    return exact.neo_hookean(F, 3.0, 0.3) - volumetric, volumetric


def remaining(g, times, t):
    return 1.0 - sum(gi * (1.0 - np.exp(-t / tau)) for gi, tau in zip(g, times, strict=True))


@pytest.mark.parametrize("bulk", [(0.0, 0.0), (0.1, 0.4), None])
def test_a_held_deformation_relaxes_as_the_series_says(bulk):
    prony = Prony((0.3, 0.2), (0.5, 4.0), bulk)
    cell = PrescribedCells(NeoHookean(young=3.0, poisson=0.3, prony=prony))
    shape, volume = split_stress(F_HELD)
    np.testing.assert_allclose(cell.step(F_HELD, 1e-12)[0], shape + volume, rtol=1e-9)
    for duration, t in ((0.3, 0.3), (0.5, 0.8), (3.0, 3.8)):
        # Steps of different lengths: the recurrence is exact while the strain rests.
        g, k = (remaining(part, (0.5, 4.0), t) for part in (prony.relative_moduli, prony.bulk))
        np.testing.assert_allclose(cell.step(F_HELD, duration)[0], g * shape + k * volume, rtol=1e-9, atol=1e-13)


def test_regions_relax_each_by_its_own_series():
    cells = PrescribedCells(MATERIAL, ELASTIC)
    cells.step(F_HELD, 1e-12)
    shape, volume = split_stress(F_HELD)
    viscous, elastic = cells.step(F_HELD, 1e4)
    np.testing.assert_allclose(viscous, 0.5 * shape + volume, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(elastic, shape + volume, rtol=1e-9, atol=1e-13)


def test_a_state_can_be_restored_and_a_step_repeated():
    cell = PrescribedCells(MATERIAL)
    cell.step(F_HELD, 0.2)
    kept, time = cell.problem.history.values(), cell.time
    first = cell.step(np.diag([1.2, 0.9, 1.0]), 0.4)
    cell.problem.history.restore(kept)
    cell.time = time
    np.testing.assert_array_equal(cell.step(np.diag([1.2, 0.9, 1.0]), 0.4), first)


@pytest.mark.parametrize(
    ("prony", "message"),
    [
        (Prony((0.3, 0.2), (1.0,)), "as many relative moduli as times"),
        (Prony((), ()), "as many relative moduli as times"),
        (Prony((0.3,), (0.0,)), "times"),
        (Prony((-0.1,), (1.0,)), "relative_moduli"),
        (Prony((0.6, 0.4), (1.0, 2.0)), "relative_moduli"),
        (Prony((0.3,), (1.0,), (1.0,)), "bulk_moduli"),
    ],
)
def test_series_that_are_no_relaxation_are_refused(prony, message):
    with pytest.raises(StudyError, match=message):
        prony.check()
