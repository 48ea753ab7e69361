"""A study whose materials come from its Abaqus input file: a bar of two materials in series."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

from morph_dslam import build, load_model, load_study, make_study
from morph_dslam.cli import app as cli
from morph_dslam.errors import StudyError
from morph_dslam.studies.file_materials import file_materials
from morph_dslam.studies.solid_sections import FileMesh

BAR = """*NODE
{nodes}
*ELEMENT, TYPE=C3D8, ELSET=soft
1, 1, 2, 3, 4, 5, 6, 7, 8
*ELEMENT, TYPE=C3D8, ELSET=stiff
2, 5, 6, 7, 8, 9, 10, 11, 12
*NSET, NSET=floor
1, 2, 3, 4
*NSET, NSET=lid
9, 10, 11, 12
*MATERIAL, NAME=Gel
*ELASTIC
1.0, 0.0
*DENSITY
1.1E-9
*MATERIAL, NAME=Putty
*ELASTIC
3.0, 0.0
*SOLID SECTION, ELSET=SOFT, MATERIAL=GEL
*SOLID SECTION, ELSET=stiff, MATERIAL=Putty
"""
SQUARE = ((0, 0), (10, 0), (10, 10), (0, 10))
NODES = [f"{4 * k + i + 1}, {x}, {y}, {10 * k}" for k in range(3) for i, (x, y) in enumerate(SQUARE)]
BAR = BAR.format(nodes="\n".join(NODES))

STUDY = """
name = "bar"
[mesh]
file = "bar.inp"
unit = "mm"
[[supports]]
kind = "fixed"
on = "floor"
[[supports]]
kind = "displacement"
on = "lid"
x = "0 mm"
y = "0 mm"
z = "pull"
[parameters.pull]
range = ["0 mm", "4 mm"]
[solver]
threads = 1
[sampling]
scheme = "even"
training = 8
held_out = 4
[reduction]
max_degree = 6
tolerance = 1e-8
"""


def written(folder: Path, bar: str = BAR, study: str = STUDY) -> Path:
    (folder / "bar.inp").write_text(bar)
    (folder / "study.toml").write_text(study)
    return folder / "study.toml"


def in_series(soft: float, stiff: float, length: float) -> tuple[float, float]:
    """Stretch of the soft cell and nominal stress of two cells 10 mm long, pulled to ``length`` mm.

    St Venant and Kirchhoff's law without lateral contraction: P = E s (s^2 - 1) / 2.
    """

    def excess(stretch: float) -> float:
        other = length / 10.0 - stretch
        return soft * stretch * (stretch**2 - 1.0) - stiff * other * (other**2 - 1.0)

    stretch = float(brentq(excess, 0.8, 1.6, xtol=1e-14))  # type: ignore[arg-type]
    return stretch, soft * stretch * (stretch**2 - 1.0) / 2.0


def test_cards_give_each_cell_its_material(tmp_path: Path) -> None:
    assert cli.main(["build", str(written(tmp_path)), "-o", str(tmp_path / "bar.morph")]) == 0
    model = load_model(tmp_path / "bar.morph")
    stretch, stress = in_series(1e6, 3e6, 23.0)
    middle = np.isclose(model.nodes[:, 2], 0.01)
    heights = model.positions(np.array([0.003]))[middle, 2]
    np.testing.assert_allclose(heights, 0.01 * stretch, rtol=1e-5)
    np.testing.assert_allclose(model.von_mises(np.array([0.003]), "solid"), stress, rtol=1e-4)


def test_the_study_may_replace_one_of_them(tmp_path: Path) -> None:
    replaced = '[materials.foam]\nlaw = "st_venant_kirchhoff"\nyoung = "2 MPa"\npoisson = 0.0\non = "soft"\n'
    path = written(tmp_path, BAR.replace("MATERIAL=GEL", "MATERIAL=lost"), STUDY + replaced)
    model = build(path, tmp_path / "bar.morph")
    _, stress = in_series(2e6, 3e6, 23.0)
    np.testing.assert_allclose(model.von_mises(np.array([0.003]), "solid"), stress, rtol=1e-4)


@pytest.mark.parametrize(("unit", "young", "density"), [("mm", 1e6, 1100.0), ("m", 1.0, 1.1e-9)], ids=["mm", "m"])
def test_the_unit_of_length_fixes_the_others(tmp_path: Path, unit: str, young: float, density: float) -> None:
    written(tmp_path)
    materials = file_materials(FileMesh(file=tmp_path / "bar.inp", unit=unit), [])
    assert list(materials) == ["soft", "stiff"]
    assert materials["soft"].young == pytest.approx(young)  # type: ignore[attr-defined]
    assert materials["soft"].density == pytest.approx(density)
    assert file_materials(FileMesh(file=tmp_path / "bar.inp", unit=unit), ["all"]) == {}


SECTION = "*SOLID SECTION, ELSET=stiff, MATERIAL=Putty"
CONSTANTS = "*ELASTIC, TYPE=ENGINEERING CONSTANTS\n3., 3., 3., 0., 0., 0., 1.5, 1.5,\n1.5\n"
MISTAKES = {
    "no such material": (SECTION, SECTION + "2", r"line \d+: there is no \*MATERIAL 'Putty2' .*Gel, Putty"),
    "no material at all": (SECTION, "*SOLID SECTION, ELSET=stiff", r"\*SOLID SECTION lacks .*MATERIAL="),
    "cell without section": (SECTION, "**", r"1 of 2 cells have no material; give one to their cell set"),
    "no such set": ("ELSET=stiff, MATERIAL", "ELSET=hard, MATERIAL", r"no element set 'hard'"),
    "twice": (SECTION, SECTION + "\n" + SECTION, r"'stiff' has a section already"),
    "empty card": ("*ELASTIC\n3.0, 0.0\n", "", r"material Putty has neither \*ELASTIC nor \*HYPERELASTIC"),
    "unstable": ("3.0, 0.0\n", "3.0, 0.7\n", r"material of 'stiff': .*poisson = 0\.7"),
    "turned axes": (
        "*ELASTIC\n3.0, 0.0\n*SOLID SECTION, ELSET=SOFT, MATERIAL=GEL\n" + SECTION,
        CONSTANTS + SECTION + ", ORIENTATION=rod",
        r"ORIENTATION=rod turns the axes of Putty",
    ),
    "viscous": (
        "3.0, 0.0\n",
        "3.0, 0.0\n*VISCOELASTIC, TIME=PRONY\n0.4, 0.4, 2.0\n",
        r"material stiff is viscoelastic: say in \[time\]",
    ),
}


@pytest.mark.parametrize("mistake", sorted(MISTAKES))
def test_a_mistake_in_the_cards_is_one_message(tmp_path: Path, capsys, mistake: str) -> None:
    before, after, message = MISTAKES[mistake]
    assert before in BAR
    path = written(tmp_path, BAR.replace(before, after))
    assert cli.main(["build", str(path), "-o", str(tmp_path / "x.morph")]) == 2
    printed = capsys.readouterr().err.splitlines()[-1]
    assert printed.startswith("morph: ")
    assert re.search(message, printed)


def test_other_units_and_missing_materials_are_refused(tmp_path: Path, capsys) -> None:
    path = written(tmp_path, study=STUDY.replace('unit = "mm"', 'unit = "cm"'))
    assert cli.main(["build", str(path), "-o", str(tmp_path / "x.morph")]) == 2
    assert "in mm (with MPa) or m (with Pa), not in cm" in capsys.readouterr().err
    bare = BAR[: BAR.index("*MATERIAL")]
    (tmp_path / "bare").mkdir()
    path = written(tmp_path / "bare", bare)
    assert cli.main(["build", str(path), "-o", str(tmp_path / "x.morph")]) == 2
    assert re.search(r"materials is missing.*bar\.inp has none", capsys.readouterr().err)
    with pytest.raises(StudyError, match="materials is missing"):
        make_study(
            {
                "name": "x",
                "mesh": {"generator": "block", "size": ["1 m"] * 3, "divisions": [1] * 3},
                "parameters": {"a": {"range": [0.0, 1.0]}},
            }
        )


def test_a_section_that_the_study_covers_in_part_is_refused(tmp_path: Path, capsys) -> None:
    one = BAR[: BAR.index("*SOLID")] + "*ELSET, ELSET=both\n1, 2\n*SOLID SECTION, ELSET=both, MATERIAL=Gel\n"
    foam = '[materials.foam]\nlaw = "neo_hookean"\nyoung = "2 MPa"\npoisson = 0.3\non = "soft"\n'
    path = written(tmp_path, one, STUDY + foam)
    assert cli.main(["build", str(path), "-o", str(tmp_path / "x.morph")]) == 2
    assert "1 of the 2 elements of 'both' have a material of the study too" in capsys.readouterr().err


def test_gravity_needs_the_density_of_every_card(tmp_path: Path) -> None:
    path = written(tmp_path, study=STUDY + '[[loads]]\nkind = "gravity"\n')
    with pytest.raises(StudyError, match="gravity needs densities, and the material of 'stiff' has none"):
        load_study(path)
    dense = BAR.replace("*MATERIAL, NAME=Putty", "*MATERIAL, NAME=Putty\n*DENSITY\n1.5E-9")
    load_study(written(tmp_path, dense, STUDY + '[[loads]]\nkind = "gravity"\n'))


def test_a_mesh_file_that_was_written_again_is_read_again(tmp_path: Path) -> None:
    """In one process too, in a notebook say."""
    longer = BAR.replace(", 20\n", ", 30\n")
    heights = [load_study(written(tmp_path, bar)).model_mesh().nodes[:, 2].max() for bar in (BAR, longer)]
    np.testing.assert_allclose(heights, [0.02, 0.03])
