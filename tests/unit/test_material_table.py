"""Materials from a study's table."""

import re

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden
from morph_dslam.mechanics.materials.isotropic import MooneyRivlin, NeoHookean, Ogden
from morph_dslam.mechanics.materials.library import constant_quantities, material_from_table
from tests.support.material_laws import BULGED as F, stress
from tests.support.real_data import ROOT


def test_a_table_becomes_its_material():
    prony = {"relative_moduli": [0.5], "times": [2.0]}
    law = material_from_table({"law": "neo_hookean", "young": 3.0, "poisson": 0.3, "density": 9.0, "prony": prony})
    assert isinstance(law, NeoHookean)
    assert (law.density, law.prony.times, law.prony.bulk) == (9.0, (2.0,), (0.5,))
    np.testing.assert_array_equal(stress(law, F), stress(NeoHookean(young=3.0, poisson=0.3), F))


def test_lists_parameters_and_directions_are_taken():
    law = material_from_table({"law": "ogden", "moduli": [0.4, 0.1], "exponents": [1.6, -2.0], "bulk": 7.0})
    same = Ogden(moduli=(0.4, 0.1), exponents=(1.6, -2.0), bulk=7.0)
    np.testing.assert_array_equal(stress(law, F), stress(same, F))
    angle = ngs.Parameter(0.5)
    table = {"law": "holzapfel_gasser_ogden", "shear": 0.5, "k1": 1.3, "k2": 0.7, "bulk": 7.0}
    turned = {"angle": angle, "from": [1, 0, 0], "towards": [0, 1, 0]}
    law = material_from_table(table | {"fibre": turned, "fibre_2": [0, 0, 1]})
    same = HolzapfelGasserOgden(
        shear=0.5, k1=1.3, k2=0.7, bulk=7.0, fibre=(np.cos(0.5), np.sin(0.5), 0), fibre_2=(0, 0, 1)
    )
    np.testing.assert_allclose(stress(law, F), stress(same, F), rtol=1e-13)


def test_a_users_function_is_loaded_from_its_file(tmp_path):
    (tmp_path / "law.py").write_text(
        "import ngsolve as ngs\n"
        "def energy(F, mu):\n"
        "    return 0.5 * mu * (ngs.InnerProduct(F, F) - 3.0) - mu * ngs.log(ngs.Det(F))\n"
    )
    table = {"law": "user_material", "function": "law.py:energy", "mu": 1.0, "bulk": 2.0}
    material = material_from_table(table, tmp_path)
    material.check()
    inverse, J = np.linalg.inv(F).T, np.linalg.det(F)
    np.testing.assert_allclose(stress(material, F), F - inverse + 2.0 * (J - 1.0) * J * inverse, rtol=1e-12)
    for reference, message in (
        ("law.py:other", "has no function other"),
        ("none.py:energy", "no file"),
        (7, "lacks its function"),
    ):
        with pytest.raises(StudyError, match=message):
            material_from_table(table | {"function": reference}, tmp_path)
    (tmp_path / "law.py").write_text("1 / 0\n")
    with pytest.raises(StudyError, match="cannot be run: division by zero"):
        material_from_table(table, tmp_path)


def test_the_documented_function_is_a_law(tmp_path):
    page = (ROOT / "docs" / "materials.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "my_law.py").write_text(program)
    table = {"law": "user_material", "function": "my_law.py:energy", "mu": 0.6, "bulk": 7.0}
    material = material_from_table(table, tmp_path)
    material.check()
    np.testing.assert_allclose(stress(material, F), stress(MooneyRivlin(c10=0.3, bulk=7.0), F), rtol=1e-12)


def test_a_users_function_without_its_constant_is_one_message(tmp_path):
    (tmp_path / "law.py").write_text("def energy(F, mu):\n    return mu\n")
    with pytest.raises(StudyError, match="missing 1 required positional argument: 'mu'"):
        material_from_table({"law": "user_material", "function": "law.py:energy"}, tmp_path).check()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"young": 3.0}, "names no law; set law to one of .*neo_hookean"),
        ({"law": "neohook"}, "'neohook' is not a known material law; known are .*neo_hookean, "),
        ({"law": "neo_hookean", "young": 3.0}, "neo_hookean lacks its constant 'poisson'"),
        ({"law": "neo_hookean", "young": 3.0, "poison": 0.3}, "has no constant 'poison'; it has .*poisson"),
        ({"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}, "young = 3 MPa is not a number"),
        ({"law": "ogden", "moduli": 0.4, "exponents": [2.0], "bulk": 7.0}, "moduli = 0.4 must be a list"),
        ({"law": "gent", "shear": 1, "limit": 5, "bulk": 7, "prony": {"times": [1]}}, "needs relative_moduli"),
        ({"law": "user_material"}, "lacks its function"),
        (
            {"law": "holzapfel_gasser_ogden", "shear": 1, "k1": 1, "k2": 1, "bulk": 7, "fibre": {"angle": 1}},
            "needs angle, from and towards",
        ),
    ],
)
def test_a_wrong_table_is_refused(table, message):
    with pytest.raises(StudyError, match=message):
        material_from_table(table)


def test_the_quantities_of_constants_are_told():
    assert constant_quantities("gent") == {
        "density": "density", "bulk": "stress", "shear": "stress", "limit": "ratio"
    }  # fmt: skip
    assert constant_quantities("ogden")["exponents"] == "ratio"
    assert constant_quantities("orthotropic")["poisson_23"] == "ratio"
    assert set(constant_quantities("holzapfel_gasser_ogden")) == {
        "density", "bulk", "shear", "k1", "k2", "dispersion"
    }  # fmt: skip
