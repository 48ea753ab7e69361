"""Material cards of an Abaqus or CalculiX input file as plain numbers in the file's units."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from morph_dslam.io.inp_cards import Card, Line

#: Names of the constants of each elastic type, in the card's order.
_ELASTIC = {
    "ISOTROPIC": ("E", "nu"),
    "ENGINEERING CONSTANTS": ("E1", "E2", "E3", "nu12", "nu13", "nu23", "G12", "G13", "G23"),
    "ORTHOTROPIC": ("D1111", "D1122", "D2222", "D1133", "D2233", "D3333", "D1212", "D1313", "D2323"),
}
#: Names of the constants of each hyperelastic model, in the card's order; Ogden's follow from its N.
_HYPERELASTIC = {
    "NEO HOOKE": ("C10", "D1"),
    "MOONEY-RIVLIN": ("C10", "C01", "D1"),
    "YEOH": ("C10", "C20", "C30", "D1", "D2", "D3"),
}


@dataclass(frozen=True)
class Constants:
    """A law and its constants, named as the Abaqus manual names them, in file units.

    ``law`` is an elastic type ("ISOTROPIC", "ENGINEERING CONSTANTS", "ORTHOTROPIC") or a hyperelastic model
    ("NEO HOOKE", "MOONEY-RIVLIN", "YEOH", "OGDEN"). Constants that the card leaves out are 0. They hold in
    the long term of a viscoelastic material unless ``instantaneous``.
    """

    law: str
    values: dict[str, float]
    line: Line
    instantaneous: bool = False


@dataclass(frozen=True)
class MaterialCard:
    """One *MATERIAL and the cards that belong to it.

    Attributes
    ----------
    name : as the file spells it.
    density : mass per volume, file units; None where it is not given.
    elastic, hyperelastic : constants, or None.
    prony : rows (g, k, tau): relative shear and bulk moduli, and the relaxation time.
    """

    name: str
    line: Line
    density: float | None = None
    elastic: Constants | None = None
    hyperelastic: Constants | None = None
    prony: tuple[tuple[float, float, float], ...] = field(default=())


def _single_row(card: Card, count: int) -> tuple[float, ...]:
    """Constants of a card whose row may go on over lines of eight; refuses tables over temperature."""
    if not card.data:
        raise card.line.error(f"*{card.keyword} lacks its constants on the line below it")
    values: list[float] = []
    for line in card.data:
        if len(values) >= count:
            raise line.error(
                f"*{card.keyword} takes {count} constants; a second row means that they depend on "
                "temperature, which is not read: keep one row"
            )
        values += [line.real(i) for i in range(len(line.fields))]
    return tuple(values)


def _constants(card: Card, law: str, names: tuple[str, ...], needed: int) -> Constants:
    values = _single_row(card, len(names))
    if len(values) < needed:
        raise card.data[-1].error(
            f"{law} needs at least {needed} constants ({', '.join(names)}); {len(values)} given"
        )
    padded = values + (0.0,) * len(names)
    instantaneous = card.parameters.get("MODULI", "LONG TERM").upper() == "INSTANTANEOUS"
    return Constants(law, dict(zip(names, padded, strict=False)), card.line, instantaneous)


def _elastic(card: Card) -> Constants:
    law = card.parameters.get("TYPE", "ISOTROPIC").upper()
    law = {"ISO": "ISOTROPIC", "ORTHO": "ORTHOTROPIC"}.get(law, law)
    if law not in _ELASTIC:
        raise card.line.error(f"*ELASTIC, TYPE={law} is not read; use {', '.join(_ELASTIC)}")
    return _constants(card, law, _ELASTIC[law], len(_ELASTIC[law]))


def _hyperelastic(card: Card) -> Constants:
    if "TEST DATA INPUT" in card.parameters:
        raise card.line.error("*HYPERELASTIC with TEST DATA INPUT is not read; give fitted constants")
    if "OGDEN" in card.parameters:
        text = card.parameters.get("N", "1")
        if not text.isdigit() or not 1 <= int(text) <= 6:
            raise card.line.error(f"N={text} is no number of Ogden terms; give 1 to 6")
        n = int(text)
        names = tuple(name for i in range(1, n + 1) for name in (f"mu{i}", f"alpha{i}"))
        return _constants(card, "OGDEN", names + tuple(f"D{i}" for i in range(1, n + 1)), 2 * n)
    for law, names in _HYPERELASTIC.items():
        if law in card.parameters:
            return _constants(card, law, names, sum(name.startswith("C") for name in names))
    given = ", ".join(card.parameters) or "no model"
    raise card.line.error(f"*HYPERELASTIC with {given} is not read; use {', '.join(_HYPERELASTIC)} or OGDEN")


def _prony(card: Card) -> tuple[tuple[float, float, float], ...]:
    if card.parameters.get("TIME", "").upper() != "PRONY":
        raise card.line.error("*VISCOELASTIC is read with TIME=PRONY only; give a Prony series")
    rows = []
    for line in card.data:
        if len(line.fields) < 3:
            raise line.error("a Prony term needs g, k and tau")
        g, k, tau = line.real(0), line.real(1), line.real(2)
        if tau <= 0.0:
            raise line.error(f"a relaxation time of {tau} cannot be; give a positive one")
        rows.append((g, k, tau))
    return tuple(rows)


def read_materials(cards: list[Card]) -> dict[str, MaterialCard]:
    """Materials by name; each takes the cards up to the next *MATERIAL.

    Raises
    ------
    StudyError
        Naming file and line, if a card lacks constants, or its law is not known.
    """
    materials: dict[str, MaterialCard] = {}
    current: MaterialCard | None = None
    for card in cards:
        if card.keyword == "MATERIAL":
            current = MaterialCard(card.required("NAME"), card.line)
        elif card.keyword in ("ELASTIC", "HYPERELASTIC", "DENSITY", "VISCOELASTIC"):
            if current is None:
                raise card.line.error(f"*{card.keyword} stands before any *MATERIAL, NAME=")
            current = _with_card(current, card)
        if current is not None:
            materials[current.name] = current
    return materials


def _with_card(material: MaterialCard, card: Card) -> MaterialCard:
    if card.keyword == "ELASTIC":
        return replace(material, elastic=_elastic(card))
    if card.keyword == "HYPERELASTIC":
        return replace(material, hyperelastic=_hyperelastic(card))
    if card.keyword == "DENSITY":
        return replace(material, density=_single_row(card, 1)[0])
    return replace(material, prony=_prony(card))
