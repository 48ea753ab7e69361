"""The unit in which the stress of stiff and soft bodies is shown, against the stretched block's closed form."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.explorer.server import ModelSurface
from morph_dslam.model.shown_field import ShownField, surface_points
from tests.support.stretched_block import YOUNG_MODULUS, stretched_block_model

STRETCH = 0.2


def block(softer):
    """The block with a Young's modulus so many times smaller, and a certificate of its largest stress."""
    model = stretched_block_model()
    solid = model.stresses["solid"]
    largest = 1e-6 * STRETCH * YOUNG_MODULUS / softer
    return replace(
        model,
        stresses={"solid": solid.with_modes(solid.modes / softer)},
        certificate={"stress_solid": {"von_mises": {"largest_MPa": largest}}},
    )


@pytest.mark.parametrize(("softer", "unit", "pascal"), [(1.0, "MPa", 1e6), (1e3, "kPa", 1e3), (1e8, "Pa", 1.0)])
def test_small_stresses_have_a_small_unit(softer, unit, pascal):
    model, mu = block(softer), np.array([STRETCH, 0.0])
    field = ShownField(model, surface_points(model)[0], "stress")
    assert (field.kind.unit, field.kind.si_factor) == (unit, pascal)
    expected = STRETCH * YOUNG_MODULUS / softer / pascal
    assert field.values(mu, field.displacement(mu)) == pytest.approx(expected, rel=1e-6)
    page = ModelSurface(model)
    assert page.values(mu, "solid") == pytest.approx(expected, rel=1e-6)
    assert [colours.unit for colours in page.fields] == ["mm", unit]


def test_without_a_certificate_stress_is_in_megapascal():
    model = replace(block(1e3), certificate={})
    assert ShownField(model, surface_points(model)[0], "stress").kind.unit == "MPa"
