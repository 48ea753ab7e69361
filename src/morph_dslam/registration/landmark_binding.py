"""Landmarks on the mesh and in the images: bound, or refused with what is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.registration.messages import UNITS, WrongUnit
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.estimator import BoundPoints
from morph_dslam.tracking.rig import RigCamera

Array = NDArray[np.float64]
#: So many landmarks show whether one of them is wrong: three fit in some pose anyway.
FEWEST_FOR_FIT = 4
#: Shares of the object's size: least extent of the landmarks, and how far one may lie off the undeformed surface.
SPREAD_SHARE, SURFACE_SHARE = 0.12, 0.01
#: The latter of hints about an object whose edges give its place in the end: they need not be exact, but no mistakes.
HINT_SURFACE_SHARE = 0.05
#: Landmarks in another unit must be spread over this share of the object: on a point they lie anywhere.
LEAST_SPREAD = 0.2
#: On a sheet landmarks lie in any smaller unit: those spread over less than the first share of it, which
#: would be spread over more than the second in another one, are flagged.
PART_OF_IT, MOST_OF_IT = 0.5, 0.6


@dataclass(frozen=True)
class BoundLandmarks:
    """Landmarks of one camera or of all cameras of a rig, those of the first one first.

    Attributes
    ----------
    points : k of them, bound to the mesh.
    pixels : (k, 2) where they were seen, without the lens's distortion.
    of_points : (k,) number of the camera that saw each.
    numbers : (k,) theirs in messages: their place in their file, from 1.
    """

    points: BoundPoints
    pixels: Array
    of_points: NDArray[np.int64]
    numbers: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[np.int64]) -> BoundLandmarks:
        """Some of them."""
        pixels = np.ascontiguousarray(self.pixels[rows])
        return BoundLandmarks(self.points.take(rows), pixels, self.of_points[rows], self.numbers[rows])

    def name(self, row: int) -> str:
        """What messages call one."""
        camera = self.of_points[row]
        return f"{self.numbers[row]} of camera {camera}" if camera else f"{self.numbers[row]}"


def bind_landmarks(model: ReducedModel, points: Array) -> BoundPoints:
    """Bind landmarks (k, 3) to the nearest points of the undeformed surface; see `register_landmarks`."""
    if len(points) < FEWEST_FOR_FIT:
        raise RegistrationError(
            f"{len(points)} landmarks are too few to register the object: give at least {FEWEST_FOR_FIT}, better "
            f"{(len(model.parameters) + 6) // 2 + 3} or more spread over it"
        )
    surface = on_surface(model, points)
    check_spread(model, points)
    return BoundPoints.from_surface(model, surface)


def bind_in_cameras(model: ReducedModel, cameras: Sequence[RigCamera], given: Sequence[Landmarks]) -> BoundLandmarks:
    """The landmarks of all cameras together, of which the first one has enough by itself.

    Raises RegistrationError if one lies off the object or outside its image, or they are too few or too close.
    """
    bound = bind_landmarks(model, given[0].points)
    check_pixels(cameras[0].camera, given[0])
    for number, (part, seen) in enumerate(zip(cameras[1:], given[1:], strict=True), start=1):
        try:
            bound = bound.joined(BoundPoints.from_surface(model, on_surface(model, seen.points)))
            check_pixels(part.camera, seen)
        except RegistrationError as error:
            raise RegistrationError(f"camera {number}: {error}") from error
    pixels = [part.camera.undistort_pixels(seen.pixels) for part, seen in zip(cameras, given, strict=True)]
    counts = [len(part) for part in pixels]
    of_points = np.repeat(np.arange(len(cameras)), counts)
    numbers = np.concatenate([np.arange(1, count + 1) for count in counts])
    return BoundLandmarks(bound, np.ascontiguousarray(np.concatenate(pixels)), of_points, numbers)


def on_surface(model: ReducedModel, points: Array, share: float = SURFACE_SHARE) -> SurfacePoints:
    """The points of the undeformed surface nearest to landmarks (k, 3).

    Raises RegistrationError if one is off it by more than a share of the object's size.
    """
    size = extent(model.nodes)
    surface, distances = nearest_surface_points(model.nodes, model.triangles, points)
    limit = share * size
    worst = int(distances.argmax())
    if distances[worst] > limit:
        x, y, z = 1e3 * points[worst]
        low, high = 1e3 * model.nodes.min(axis=0), 1e3 * model.nodes.max(axis=0)
        ranges = ", ".join(f"{axis} {a:.4g}..{b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise RegistrationError(
            f"landmark {worst + 1} at ({x:g}, {y:g}, {z:g}) mm is {1e3 * distances[worst]:.1f} mm off the "
            f"object, at most {1e3 * limit:.1f} mm are allowed: landmarks are points of the "
            f"undeformed object ({ranges} mm){_unit_hint(model, points)}"
        )
    return surface


def check_spread(model: ReducedModel, points: Array) -> None:
    """Refuse landmarks (k, 3) that are all in one corner of the object."""
    size, spread = extent(model.nodes), extent(points)
    if spread < SPREAD_SHARE * size:
        raise RegistrationError(
            f"the landmarks are {1e3 * spread:.3g} mm apart on an object of {1e3 * size:.3g} mm: spread them "
            f"over all that is seen of it{_unit_hint(model, points)}"
        )


def other_unit(model: ReducedModel, points: Array, least: float) -> WrongUnit | None:
    """In which unit of the mesh landmarks (k, 3) would lie on the object, spread over this share of it."""
    size, found = extent(model.nodes), None
    best = least * size
    for (meant, a), (taken, b) in permutations(UNITS.items(), 2):
        scaled = points * (b / a)
        _, distances = nearest_surface_points(model.nodes, model.triangles, scaled)
        if distances.max() <= SURFACE_SHARE * size and extent(scaled) > best:
            best = extent(scaled)
            found = WrongUnit(extent(points), size, a / b, meant, taken)
    return found


def _unit_hint(model: ReducedModel, points: Array) -> str:
    found = other_unit(model, points, LEAST_SPREAD)
    return "" if found is None else found.hint


def extent(points: Array) -> float:
    """Length of the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def check_pixels(camera: Camera, landmarks: Landmarks) -> None:
    """Refuse landmarks whose pixels are not in the image."""
    pixels = landmarks.pixels
    outside = ~((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        frame = "the reference frame" if landmarks.frames is None else f"frame {landmarks.frames[row]}"
        raise RegistrationError(
            f"landmark {row + 1} has the pixel ({pixels[row, 0]:g}, {pixels[row, 1]:g}), outside the "
            f"{camera.width}x{camera.height} image: give pixels of {frame}"
        )
