"""Inner structures: a tumour, a vessel or a wire inside a solid, as a mesh that the solid carries along.

Its nodes are material points of the solid, so that they move as the displacement field does there. It adds
nothing to the mechanics: a stiff inclusion belongs into the solid's own mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ModelFileError, refusal
from morph_dslam.io.hdf5_writing import written_hdf5
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.field_storage import read_array, read_text
from morph_dslam.model.reduced_model import MaterialPoints, ReducedModel
from morph_dslam.model.separated import SeparatedField

Array = NDArray[np.float64]
FORMAT = "morph-dslam inner structure"
VERSION = 1
#: Colours in turn, sRGB: violet, yellow, green, blue; and the opacity of a surface that shows what it has inside.
COLOURS = ((235, 60, 235), (255, 220, 60), (90, 235, 90), (60, 190, 255))
SEE_THROUGH = 0.4
#: How far a node may lie from where the model puts it, over the model's size.
TOLERANCE = 1e-6


def colour_of(number: int) -> tuple[int, int, int]:
    """Red, green and blue of a structure by its number in the object, the same in videos, files and streams."""
    return COLOURS[number % len(COLOURS)]


@dataclass(frozen=True)
class CarriedStructure:
    """An inner structure in one model.

    Attributes
    ----------
    name : of the structure.
    triangles : (m, 3) its surface.
    rest : (p, 3) its nodes in the undeformed object, metres.
    field : their displacement.
    """

    name: str
    triangles: NDArray[np.int64]
    rest: Array
    field: SeparatedField

    def nodes(self, mu: ArrayLike, beyond: Discrepancy | None = None) -> Array:
        """Deformed nodes (p, 3) in the object frame, metres, with what the shape has beyond the model's."""
        nodes = self.rest + self.field.value(mu)
        return nodes if beyond is None else nodes + beyond.displacement(self.rest)

    def centre_and_sensitivities(self, mu: ArrayLike) -> tuple[Array, Array]:
        """Mean of the deformed nodes (3,) in the object frame, metres, and its derivatives (d, 3)."""
        displacement, sensitivities = self.field.value_and_sensitivities(mu)
        return (self.rest + displacement).mean(axis=0), sensitivities.mean(axis=1)


@dataclass(frozen=True)
class InnerStructure:
    """What a file of an inner structure holds.

    Attributes
    ----------
    name : shown in reports and pictures.
    rest : (p, 3) nodes in the undeformed object, object frame, metres.
    triangles : (m, 3) its surface, node indices.
    points : where the nodes lie in the cells of the model that it was made for.
    """

    name: str
    rest: Array
    triangles: NDArray[np.int64]
    points: MaterialPoints

    def carried_by(self, model: ReducedModel) -> CarriedStructure:
        """The structure as ``model`` moves it."""
        same = self.points.corners.max(initial=-1) < len(model.nodes)
        if same:
            gap = np.abs(model.rest_positions(self.points) - self.rest).max(initial=0.0)
            same = bool(gap <= TOLERANCE * np.ptp(model.nodes, axis=0).max())
        if not same:
            raise ModelFileError(
                f"the inner structure '{self.name}' was not made for the mesh of the model '{model.name}': "
                "make it again with `morph inner`"
            )
        return CarriedStructure(self.name, self.triangles, self.rest, model.restrict(self.points))


def save_inner_structure(path: str | Path, structure: InnerStructure) -> None:
    """Write a file that `load_inner_structure` reads."""
    path = Path(path)
    try:
        with written_hdf5(path) as file:
            file.attrs.update({"format": FORMAT, "version": VERSION, "name": structure.name})
            file["rest"], file["triangles"] = structure.rest, structure.triangles
            file["corners"], file["weights"] = structure.points.corners, structure.points.weights
    except OSError as error:
        raise ModelFileError(f"cannot write the inner structure {refusal(error, path)}") from error


def load_inner_structure(path: Path) -> InnerStructure:
    """Read and check the file of an inner structure.

    Raises
    ------
    ModelFileError
        If the file is missing, damaged, or something else.
    """
    if not path.is_file():
        raise ModelFileError(f"there is no inner structure {path}: `morph inner` makes one")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT or file.attrs.get("version") != VERSION:
                raise ValueError(f"it is no {FORMAT} of version {VERSION}")
            points = MaterialPoints(
                read_array(file, "corners", 2, np.int64), read_array(file, "weights", 2, np.float64)
            )
            structure = InnerStructure(
                read_text(file, "name"), read_array(file, "rest", 2), read_array(file, "triangles", 2, np.int64), points
            )
        _check(structure)
    except Exception as error:
        # h5py raises half a dozen types on damaged files, RuntimeError and KeyError among them.
        raise ModelFileError(
            f"{path} is no inner structure that can be read ({error}): make it again with `morph inner`"
        ) from error
    return structure


def load_inner_structures(paths: Sequence[Path], model: ReducedModel) -> tuple[InnerStructure, ...]:
    """Structures inside of one model, each of a name of its own.

    Raises
    ------
    ModelFileError
        If a file cannot be read or is not for this model, or two have one name.
    """
    found: dict[str, InnerStructure] = {}
    for path in paths:
        structure = load_inner_structure(path)
        structure.carried_by(model)  # raises if it is not for this model
        if structure.name in found:
            raise ModelFileError(
                f"two inner structures are called '{structure.name}', the second one is {path}: make it again with "
                "another --name of `morph inner`"
            )
        found[structure.name] = structure
    return tuple(found.values())


def _check(structure: InnerStructure) -> None:
    count, corners = len(structure.rest), structure.points.corners
    if not count or structure.rest.shape[1] != 3 or structure.triangles.shape[1] != 3:
        raise ValueError("its arrays have the wrong shapes")
    if structure.points.weights.shape != corners.shape or len(corners) != count:
        raise ValueError("its points do not belong to its nodes")
    if corners.min() < 0 or structure.triangles.min(initial=0) < 0 or structure.triangles.max() >= count:
        raise ValueError("it refers to nodes that are not there")
