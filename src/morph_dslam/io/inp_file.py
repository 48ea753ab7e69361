"""Abaqus and CalculiX input files: nodes, elements, sets and surfaces as plain data.

Numbers stay in the file's own units and labels. Cards that do not describe the mesh (materials, sections, steps,
boundary conditions, output) are skipped; those that would generate or move nodes are refused, so that no part of a
mesh is lost silently.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.inp_cards import Card, LabelSets, Line, read_cards

Labels = NDArray[np.int64]
#: Cell type and number of nodes by the stem of the element type; the letters after it choose an integration
#: or a formulation, which a study chooses anew.
ELEMENTS = {
    "C3D4": ("tet4", 4), "C3D6": ("prism6", 6), "C3D8": ("hex8", 8), "C3D10": ("tet10", 10),
    "C3D15": ("prism15", 15), "C3D20": ("hex20", 20), "C3D27": ("hex27", 27),
    "S3": ("tri3", 3), "S4": ("quad4", 4), "S6": ("tri6", 6), "STRI65": ("tri6", 6), "S8": ("quad8", 8),
}  # fmt: skip
_ELEMENT_TYPE = re.compile(rf"({'|'.join(ELEMENTS)})([A-Z]+\d?)?")
_GENERATING = (
    "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "SUBMODEL", "SYMMETRIC MODEL GENERATION",
)  # fmt: skip


@dataclass(frozen=True)
class Elements:
    """Elements of one type.

    Attributes
    ----------
    cell_type : "hex8" and so on.
    labels : (m,) element labels.
    connectivity : (m, k) node labels in the file's order.
    lines : for each element, where it was read.
    """

    cell_type: str
    labels: Labels
    connectivity: Labels
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class SurfacePart:
    """Labels of elements and the face that each gives to a surface: S1 to S6, SPOS, SNEG, or "" for all."""

    elements: Labels
    face: str
    line: Line


@dataclass(frozen=True)
class InpFile:
    """The mesh of an input file.

    Attributes
    ----------
    node_labels : (n,) labels.
    nodes : (n, 3) coordinates, file units.
    elements : the elements, one entry for each *ELEMENT card.
    node_sets : labels by name, as the file spells it first.
    element_sets : labels by name, likewise.
    surfaces : parts of each element surface by name.
    """

    path: Path
    node_labels: Labels
    nodes: NDArray[np.float64]
    elements: tuple[Elements, ...]
    node_sets: Mapping[str, Labels] = field(default_factory=dict)
    element_sets: Mapping[str, Labels] = field(default_factory=dict)
    surfaces: Mapping[str, tuple[SurfacePart, ...]] = field(default_factory=dict)


def _read_nodes(cards: list[Card], sets: LabelSets) -> tuple[Labels, NDArray[np.float64]]:
    places: dict[int, tuple[float, float, float]] = {}
    for card in cards:
        if card.parameters.get("SYSTEM", "R").upper() != "R" or "INPUT" in card.parameters:
            raise card.line.error("*NODE with SYSTEM= or INPUT= is not read; list Cartesian coordinates below it")
        labels = []
        for line in card.data:
            if not 3 <= len(line.fields) <= 7:
                raise line.error("a node needs a label and two or three coordinates")
            padded = Line((*line.fields, "", "")[:4], line.path, line.number)
            label, place = line.integer(0), (padded.real(1), padded.real(2), padded.real(3))
            if places.setdefault(label, place) != place:
                raise line.error(f"node {label} was given other coordinates before; give each label once")
            labels.append(label)
        sets.add(card.parameters.get("NSET"), labels)
    return np.array(list(places), dtype=np.int64), np.array(list(places.values())).reshape(-1, 3)


def element_type(card: Card) -> tuple[str, int]:
    """Cell type and number of nodes of an *ELEMENT card; StudyError listing the known types if it is none."""
    if "INPUT" in card.parameters:
        raise card.line.error("*ELEMENT with INPUT= is not read; use *INCLUDE")
    name = card.required("TYPE").upper()
    match = _ELEMENT_TYPE.fullmatch(name)
    if match is None:
        raise card.line.error(
            f"element type {name} is not known; use {', '.join(ELEMENTS)} (with any suffix), or take these "
            "elements out (Gmsh adds lines and surfaces to an .inp: save a .msh instead)"
        )
    return ELEMENTS[match[1]]


def _read_elements(card: Card) -> Elements:
    cell_type, n_nodes = element_type(card)
    labels, connectivity, lines = [], [], []
    row: list[int] = []
    begun = card.line
    for line in card.data:
        if not row:
            begun = line
        row += [line.integer(i) for i, text in enumerate(line.fields) if text]
        if len(row) > n_nodes + 1:
            raise begun.error(f"element {row[0]} has {len(row) - 1} nodes; a {cell_type} has {n_nodes}")
        if len(row) == n_nodes + 1:
            labels.append(row[0])
            connectivity.append(row[1:])
            lines.append(begun)
            row = []
    if row:
        raise begun.error(f"element {row[0]} ends after {len(row) - 1} of its {n_nodes} nodes")
    nodes = np.array(connectivity, dtype=np.int64).reshape(-1, n_nodes)
    return Elements(cell_type, np.array(labels, dtype=np.int64), nodes, tuple(lines))


def _check_references(elements: tuple[Elements, ...], node_labels: Labels) -> None:
    seen: set[int] = set()
    for part in elements:
        missing = ~np.isin(part.connectivity, node_labels)
        for i in np.flatnonzero(missing.any(axis=1))[:1]:
            label, node = part.labels[i], part.connectivity[i][missing[i]][0]
            raise part.lines[i].error(f"element {label} refers to node {node}, which the file does not define")
        for label, line in zip(part.labels.tolist(), part.lines, strict=True):
            if label in seen:
                raise line.error(f"element {label} was defined before; give each label once")
            seen.add(label)


def _nodes_of(elements: tuple[Elements, ...], labels: Labels) -> list[int]:
    chosen = [part.connectivity[np.isin(part.labels, labels)].ravel() for part in elements]
    return np.unique(np.concatenate(chosen)).tolist()


def _read_surface(
    card: Card, element_sets: LabelSets, node_sets: LabelSets, defined: Labels
) -> tuple[SurfacePart, ...]:
    """Parts of an element surface; a node surface becomes a node set of its name."""
    name, kind = card.required("NAME"), card.parameters.get("TYPE", "ELEMENT").upper()
    if kind == "NODE":
        for line in card.data:
            node_sets.add_line(name, Line(line.fields[:1], line.path, line.number))
        return ()
    if kind != "ELEMENT":
        raise card.line.error(f"a surface of type {kind} is not read; use TYPE=ELEMENT or TYPE=NODE")
    parts = []
    for line in card.data:
        face = line.fields[1].upper() if len(line.fields) > 1 else ""
        if not re.fullmatch(r"(S[1-6]|SPOS|SNEG)?", face):
            raise line.error(f"'{face}' is no face of an element; use S1 to S6, SPOS or SNEG")
        parts.append(SurfacePart(element_sets.entry(line, 0, defined), face, line))
    return tuple(parts)


def _refuse_what_moves_nodes(cards: list[Card]) -> None:
    for card in cards:
        if card.keyword in _GENERATING:
            raise card.line.error(f"*{card.keyword} is not read; write out the nodes and elements that it makes")
    instances = [card for card in cards if card.keyword == "INSTANCE"]
    placed = [card for card in instances if card.data]
    for card in (*placed, *instances[1:]):
        raise card.line.error("assemblies of placed instances are not read; write a flat input file of one part")


def read_inp(path: Path) -> InpFile:
    """Read an input file.

    Raises StudyError naming file and line, if a card is malformed, cut short, of an unknown type, or refers to what is
    not there.
    """
    path = Path(path)
    cards = read_cards(path)
    _refuse_what_moves_nodes(cards)
    by_keyword: dict[str, list[Card]] = {}
    for card in cards:
        by_keyword.setdefault(card.keyword, []).append(card)
    node_sets, element_sets = LabelSets("node"), LabelSets("element")
    labels, nodes = _read_nodes(by_keyword.get("NODE", []), node_sets)
    element_cards = by_keyword.get("ELEMENT", [])
    elements = tuple(_read_elements(card) for card in element_cards)
    if not len(labels) or not any(len(part.labels) for part in elements):
        raise StudyError(f"{path} holds no {'elements' if len(labels) else 'nodes'}; it is no mesh, or is cut short")
    _check_references(elements, labels)
    for card, part in zip(element_cards, elements, strict=True):
        element_sets.add(card.parameters.get("ELSET"), part.labels.tolist())
    for card in by_keyword.get("ELSET", []):
        element_sets.add_card(card, "ELSET")
    element_labels = np.concatenate([part.labels for part in elements])
    for card in by_keyword.get("NSET", []):
        if "ELSET" in card.parameters:
            chosen = element_sets.named(card.required("ELSET"), card.line, element_labels)
            node_sets.add(card.required("NSET"), _nodes_of(elements, chosen))
        else:
            node_sets.add_card(card, "NSET")
    surfaces = {
        card.required("NAME"): _read_surface(card, element_sets, node_sets, element_labels)
        for card in by_keyword.get("SURFACE", [])
    }
    return InpFile(
        path=path,
        node_labels=labels,
        nodes=nodes,
        elements=elements,
        node_sets=node_sets.resolved(labels),
        element_sets=element_sets.resolved(element_labels),
        surfaces={name: parts for name, parts in surfaces.items() if parts},
    )
