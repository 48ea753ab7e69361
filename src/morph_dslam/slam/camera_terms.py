"""The terms of a camera that a recording can show, and what it shows of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import LONGEST_READOUT_S, Camera

Array = NDArray[np.float64]
#: What can be estimated of a camera.
CameraTerm = Literal["focal", "centre", "radial", "tangential", "readout"]
TERMS: tuple[CameraTerm, ...] = get_args(CameraTerm)
#: What a check estimates: tangential terms that matter are rare, and hide a principal point that is wrong.
CHECKED: tuple[CameraTerm, ...] = ("focal", "centre", "radial", "readout")
#: Unknowns of each term: logarithm of the focal length, principal point in pixels, k1 and k2, p1 and p2, seconds.
COLUMNS: dict[CameraTerm, list[int]] = {
    "focal": [0], "centre": [1, 2], "radial": [3, 4], "tangential": [5, 6], "readout": [7],
}  # fmt: skip
N_UNKNOWNS = 8
#: Standard deviations of the unknowns before anything is measured, the principal point's in image widths.
#: Elements of a lens are centred so well that p1 and p2 of a calibration are seldom above two thousandths.
PRIOR_STD = np.array([0.3, 0.1, 0.1, 0.3, 0.3, 0.002, 0.002, 0.03])
#: A departure is named if it exceeds so many standard deviations and matters: as a part of the focal length; of half
#: the image's diagonal, for the principal point and for the lens (root mean square over the image); in pixels that
#: the points move by, for the readout time.
SIGNIFICANT = 3.0
MATTERS: dict[CameraTerm, float] = {"focal": 0.03, "centre": 0.03, "radial": 0.02, "tangential": 0.02, "readout": 0.5}
#: A term is unobservable if two deviations exceed so many times what matters.
UNOBSERVABLE = 3.0


@dataclass(frozen=True)
class TermEstimate:
    """One term of a camera as a recording shows it.

    Attributes
    ----------
    given, estimated, std : of its values: fx in pixels, (cx, cy) in pixels, (k1, k2), (p1, p2), seconds
    departure, departure_std : between both, as a part of the focal length, in pixels of the principal point, in pixels
        of the lens (root mean square over the image), in pixels that points move by while the image is read out
    matters : from where on a departure matters, in the same unit
    """

    given: tuple[float, ...]
    estimated: tuple[float, ...]
    std: tuple[float, ...]
    departure: float
    departure_std: float
    matters: float

    def facts(self) -> dict[str, list[float] | bool]:
        """Of the summary."""
        values = {name: list(getattr(self, name)) for name in ("given", "estimated", "std")}
        return values | {"is_wrong": self.is_wrong, "is_observable": self.is_observable}

    @property
    def is_refuted(self) -> bool:
        """Whether the recording contradicts the given value, by much or by little."""
        return self.departure > SIGNIFICANT * self.departure_std

    @property
    def is_wrong(self) -> bool:
        """Whether the given value is refuted, and matters."""
        return self.is_refuted and self.departure > self.matters

    @property
    def is_observable(self) -> bool:
        """Whether the recording would show a value that is wrong by much."""
        return 2.0 * self.departure_std < UNOBSERVABLE * self.matters


@dataclass(frozen=True)
class CameraEstimate:
    """A camera as a recording shows it.

    Attributes
    ----------
    camera : with the terms that were free as estimated
    terms : those that were free
    """

    camera: Camera
    terms: dict[CameraTerm, TermEstimate]


def changed(camera: Camera, unknowns: Array) -> Camera:
    """The camera with its unknowns (8,) changed by so much."""
    factor, distortion = float(np.exp(unknowns[0])), camera.distortion
    if unknowns[3:7].any():
        given = distortion or (0.0,) * 4
        distortion = (*(value + float(change) for value, change in zip(given, unknowns[3:7], strict=False)), *given[4:])
    readout = float(np.clip(camera.readout_s + unknowns[7], -LONGEST_READOUT_S, LONGEST_READOUT_S))
    return replace(
        camera,
        fx=factor * camera.fx,
        fy=factor * camera.fy,
        cx=camera.cx + float(unknowns[1]),
        cy=camera.cy + float(unknowns[2]),
        distortion=distortion,
        readout_s=readout,
    )


def terms_of(camera: Camera, terms: Sequence[CameraTerm] = TERMS) -> list[CameraTerm]:
    """Those of the terms that a camera has: a fisheye has no tangential ones."""
    return [term for term in terms if term != "tangential" or camera.lens_model == "radial-tangential"]


def with_terms_of(camera: Camera, other: Camera, terms: Sequence[CameraTerm]) -> Camera:
    """The camera with some terms of another one."""
    fields = {"focal": ("fx", "fy"), "centre": ("cx", "cy"), "readout": ("readout_s",)}
    result = replace(camera, **{name: getattr(other, name) for term in terms for name in fields.get(term, ())})
    return replace(result, distortion=_lens_of(camera.distortion, other.distortion, terms))


def _lens_of(own: tuple[float, ...], other: tuple[float, ...], terms: Sequence[CameraTerm]) -> tuple[float, ...]:
    """Coefficients with some terms of another lens; a lens without coefficients has zeros."""
    count = max(len(own), len(other), 4)
    pairs = zip(*(lens + (0.0,) * (count - len(lens)) for lens in (own, other)), strict=True)
    mixed = tuple(theirs if _term_of(k) in terms else mine for k, (mine, theirs) in enumerate(pairs))
    same = (lens for lens in (own, other) if mixed == lens + (0.0,) * (count - len(lens)))
    return next(same, mixed)


def _term_of(coefficient: int) -> CameraTerm:
    """The term that a coefficient of a radial-tangential lens belongs to."""
    return "tangential" if coefficient in (2, 3) else "radial"


def prior_std(camera: Camera) -> Array:
    """Standard deviations (8,) of the unknowns before anything is measured."""
    return PRIOR_STD * np.where(np.isin(np.arange(N_UNKNOWNS), COLUMNS["centre"]), camera.width, 1.0)


def values_of(camera: Camera, term: CameraTerm) -> tuple[float, ...]:
    """The values of a term: fx in pixels, (cx, cy) in pixels, (k1, k2), (p1, p2), seconds."""
    k1, k2, p1, p2, *_ = camera.distortion or (0.0,) * 4
    values: dict[CameraTerm, tuple[float, ...]] = {
        "focal": (camera.fx,),
        "centre": (camera.cx, camera.cy),
        "radial": (k1, k2),
        "tangential": (p1, p2),
        "readout": (camera.readout_s,),
    }
    return values[term]
