"""Units against published factors (NIST Special Publication 811, appendix B.8)."""

import pytest

from morph_dslam.units import to_si


@pytest.mark.parametrize(("unit", "pascal"), [("psi", 6894.757), ("bar", 1e5), ("mbar", 100.0)])
def test_pressures(unit, pascal):
    assert to_si(1.0, unit, "pressure") == pytest.approx(pascal, rel=1e-7)
    assert to_si(1.0, unit, "stress") == to_si(1.0, unit, "pressure")
