"""The analytic sheet is what it says: its separated form equals the closed formula."""

import numpy as np

from tests.support.bent_sheet import LENGTH, bent_sheet_model


def test_separated_form_equals_the_formula():
    model = bent_sheet_model(9, 7)
    arch, skew, twist = 0.05, -0.4, 0.2
    x, y, _ = model.nodes.T
    s = 2 * x / LENGTH
    z = arch * (1 - s**2) * (1 + skew * s) + twist * s * y
    np.testing.assert_allclose(model.positions(np.array([arch, skew, twist]))[:, 2], z, atol=1e-15)
    np.testing.assert_allclose(model.positions(model.default), model.nodes, atol=1e-15)


def test_length_along_the_middle_is_kept_to_second_order():
    model = bent_sheet_model()
    middle = np.flatnonzero(model.nodes[:, 1] == 0.0)
    for arch in (0.01, 0.02):
        line = model.positions(np.array([arch, 0.5, 0.3]))[middle]
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        assert abs(length / LENGTH - 1) < 12 * (arch / LENGTH) ** 3
