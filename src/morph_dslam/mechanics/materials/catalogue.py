"""Materials with measured constants and their sources, for those who have not tested their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class CataloguedMaterial:
    """A material as a study's section [materials.NAME] states it, and where its constants come from.

    Attributes
    ----------
    name : what it is called in a study.
    title : for people.
    section : keys and values of the section.
    source : publication or data sheet.
    note : how far the constants hold.
    """

    name: str
    title: str
    section: Mapping[str, Any]
    source: str
    note: str

    def content(self) -> dict[str, Any]:
        """All of it as plain JSON."""
        return asdict(self) | {"section": dict(self.section)}


def material_catalogue() -> tuple[CataloguedMaterial, ...]:
    """The materials that are known, from hard to soft within each kind."""
    return _CATALOGUE


_TENSILE = (
    "constants fitted here to the pull-to-failure test of L. Marechal et al., Soft Robotics 8, 284 (2021), "
    "github.com/LucMarechal/Soft-Robotics-Materials-Database"
)
_BULK = "Bulk modulus chosen, 1000 times the shear modulus."
_FIRST_LOADING = f"First loading in tension, up to three times the length. {_BULK}"

_CATALOGUE: tuple[CataloguedMaterial, ...] = (
    CataloguedMaterial(
        name="paper",
        title="Paper for printers",
        section={"law": "st_venant_kirchhoff", "young": "5.32 GPa", "poisson": 0.3},
        source="tensile tests of strips, supplement of a study of self-folding corrugated paper, "
        "yvm2020.authorea.com/users/450520/articles/549430",
        note="Tension up to 0.25 % strain, in one direction, which is not stated. Paper is about half as stiff across "
        "the machine's direction as along it. Poisson's ratio chosen. Thin sheets are better solved as shells, with "
        "the same two constants.",
    ),
    CataloguedMaterial(
        name="natural_rubber",
        title="Natural rubber (Treloar)",
        section={
            "law": "ogden",
            "moduli": ["0.4095 MPa", "0.003 MPa", "0.01 MPa"],
            "exponents": [1.3, 5.0, -2.0],
            "bulk": "422.5 MPa",
        },
        source="R. W. Ogden, Proc. R. Soc. Lond. A 326, 565 (1972), fitted to tests of L. R. G. Treloar (1944)",
        note=f"Stretches up to 7. Moduli are half of Ogden's times his exponents. {_BULK}",
    ),
    CataloguedMaterial(
        name="sylgard_184",
        title="PDMS, Sylgard 184, cured at 25 °C",
        section={"law": "mooney_rivlin", "c10": "0.22 MPa", "bulk": "440 MPa"},
        source="I. D. Johnston et al., J. Micromech. Microeng. 24, 035017 (2014)",
        note=f"Young's modulus 1.32 MPa, up to 40 % strain; 2.97 MPa if cured at 200 °C. {_BULK}",
    ),
    CataloguedMaterial(
        name="tango_plus",
        title="TangoPlus, printed",
        section={"law": "mooney_rivlin", "c10": "0.068 MPa", "c01": "0.045 MPa", "bulk": "226 MPa"},
        source="constants fitted here to the force curves of two notched strips of V. Slesarenko (2019), "
        "github.com/slslesarenko/jupyterWSM (examples/rubber_tension)",
        note="First loading in tension, up to 1.5 times the length, within 5 %; a strip of another batch, 3 %. Printed "
        f"rubber is softer when pulled slowly. {_BULK}",
    ),
    CataloguedMaterial(
        name="soft_foam",
        title="Soft open-cell foam",
        section={"law": "neo_hookean", "young": "130 kPa", "poisson": 0.3, "density": "33 kg/m3"},
        source="J.-F. Allard, N. Atalla, Propagation of Sound in Porous Media (2009), table 11.3, as transcribed in "
        "github.com/Matael/PLANES-Materials",
        note="Small strains: cell walls buckle from about 5 % of compression on, and the foam becomes much softer.",
    ),
    CataloguedMaterial(
        name="mold_star_16",
        title="Mold Star 16 FAST",
        section={"law": "yeoh", "c10": "42 kPa", "c20": "2.6 kPa", "bulk": "84 MPa"},
        source=_TENSILE,
        note=_FIRST_LOADING,
    ),
    CataloguedMaterial(
        name="mold_star_15",
        title="Mold Star 15 SLOW",
        section={"law": "mooney_rivlin", "c10": "48.3 kPa", "bulk": "96.7 MPa", "density": "1080 kg/m3"},
        source="shear modulus 96.7 kPa fitted here to the depth image of a bar that hangs by its own weight "
        "(examples/diffcal_silicone)",
        note=f"Bending under own weight. Coarse linear tetrahedra, which lock, give half of it. {_BULK}",
    ),
    CataloguedMaterial(
        name="dragon_skin_10",
        title="Dragon Skin 10 MEDIUM",
        section={"law": "yeoh", "c10": "22.5 kPa", "c20": "2.1 kPa", "bulk": "45 MPa", "density": "1070 kg/m3"},
        source=_TENSILE,
        note=_FIRST_LOADING,
    ),
    CataloguedMaterial(
        name="ecoflex_00_50",
        title="Ecoflex 00-50",
        section={"law": "yeoh", "c10": "10.4 kPa", "c20": "0.267 kPa", "bulk": "20.8 MPa", "density": "1070 kg/m3"},
        source=_TENSILE,
        note=_FIRST_LOADING,
    ),
    CataloguedMaterial(
        name="ecoflex_00_30",
        title="Ecoflex 00-30",
        section={"law": "yeoh", "c10": "7.54 kPa", "c20": "0.13 kPa", "bulk": "15.1 MPa"},
        source=_TENSILE,
        note=_FIRST_LOADING,
    ),
    CataloguedMaterial(
        name="liver",
        title="Liver, healthy",
        section={"law": "mooney_rivlin", "c10": "0.9 kPa", "bulk": "1.8 MPa", "density": "1060 kg/m3"},
        source="Phys. Med. Biol. 64, 225001 (2019), table 1 (PMC6925591), from measurements of several groups",
        note=f"Shear modulus 1.8 kPa, standard deviation 0.4 kPa, for small strains. {_BULK}",
    ),
)
