"""What bodies weigh, and densities that no material has."""

import pytest

from morph_dslam.errors import StudyError
from morph_dslam.studies.build import build
from morph_dslam.studies.provenance import study_warnings
from morph_dslam.studies.study import load_study
from morph_dslam.studies.weights import announced_mass

WEIGHED = """name = "block"
[mesh]
generator = "block"
size = ["30 mm", "20 mm", "100 mm"]
divisions = [1, 1, 2]
[materials.silicone]
law = "neo_hookean"
young = "300 kPa"
poisson = 0.4
density = "{density}"
[[supports]]
kind = "fixed"
on = "z_min"
[[loads]]
kind = "gravity"
acceleration = ["-1 * pull", "0 m/s2", "0 m/s2"]
[parameters.pull]
range = ["0 m/s2", "9 m/s2"]
"""


@pytest.mark.parametrize(
    ("density", "mass", "meant"),
    [
        ("1.07 kg/m3", "64.2 mg", 'Write "1.07 g/cm3"'),
        ("1070 g/cm3", "64.2 kg", 'Write "1070 kg/m3"'),
        ("0.001 kg/m3", "0.06 mg", "check its unit"),
        ("1.07 g/cm3", "64.2 g", None),
        ("30 kg/m3", "1.8 g", None),
        ("19300 kg/m3", "1.16 kg", None),
        ("0 kg/m3", "0 mg", None),
    ],
)
def test_a_density_of_no_material_is_asked_about_and_the_mass_is_told(tmp_path, density, mass, meant):
    """A block of 60 cm3."""
    (tmp_path / "study.toml").write_text(WEIGHED.format(density=density))
    study = load_study(tmp_path / "study.toml")
    assert announced_mass(study, study.solid_mesh()) == mass
    said = study_warnings(study)
    assert len(said) == (meant is not None)
    assert meant is None or ("'silicone' has a density" in said[0] and meant in said[0])


def test_bodies_of_several_materials_weigh_what_all_do(tmp_path):
    """The lower half of the block has another density than the upper one, which goes on without any."""
    halves = (
        WEIGHED.replace("poisson = 0.4\n", 'poisson = 0.4\non = "lower"\n').format(density="1000 kg/m3")
        + """
[sets]
lower = { box = [["-1 mm", "-1 mm", "-1 mm"], ["31 mm", "21 mm", "51 mm"]] }
upper = { box = [["-1 mm", "-1 mm", "49 mm"], ["31 mm", "21 mm", "101 mm"]] }
[materials.steel]
law = "neo_hookean"
young = "1 MPa"
poisson = 0.4
on = "upper"
density = "7.8 g/cm3"
"""
    )
    pushed = 'kind = "force"\non = "z_max"\nforce = ["-1 * pull", "0 N", "0 N"]\n'
    forced = halves.replace('kind = "gravity"\nacceleration = ["-1 * pull", "0 m/s2", "0 m/s2"]\n', pushed)
    forced = forced.replace('["0 m/s2", "9 m/s2"]', '["0 N", "1 N"]')
    for text, mass in ((halves, "264 g"), (forced, "264 g"), (forced.replace('density = "7.8 g/cm3"\n', ""), None)):
        (tmp_path / "study.toml").write_text(text)
        study = load_study(tmp_path / "study.toml")
        assert announced_mass(study, study.solid_mesh()) == mass  # 30 cm3 of each


def test_a_shell_weighs_what_its_thickness_makes_of_its_area(tmp_path, capsys, monkeypatch):
    """A plate of 8 cm2, 1.5 mm thick where nothing else is said: told before anything is solved."""

    def unsolved(*_):
        raise StudyError("not solved")

    monkeypatch.setattr("morph_dslam.studies.build.take_snapshots", unsolved)
    (tmp_path / "study.toml").write_text("""name = "plate"
mesh = { generator = "plate", size = ["40 mm", "20 mm"], divisions = [2, 1] }
shell = { thickness = "thick" }
supports = [{ kind = "clamped", on = "x_min" }]
material = { young = "1 GPa", poisson = 0.3, density = "2 kg/m3" }
loads = [{ kind = "gravity" }]
[parameters.thick]
range = ["1 mm", "2 mm"]
default = "1.5 mm"
""")
    with pytest.raises(StudyError, match="not solved"):
        build(tmp_path / "study.toml")
    said = capsys.readouterr().err
    assert "mesh: 40 x 20 x 0 mm, 2 quad9, 15 nodes, 2.4 mg" in said
    assert "note: the material has a density of 2 kg/m3, less than a foam has: is 2 g/cm3 meant?" in said
