"""Which pictures of a scan show what the first reference view does not, and which of them are to be believed.

A map holds pictures of the object from all sides, with its place in each. Those are taken that show most of
the surface much larger than the pictures taken so far. Something may have been before the object in one of
them, so what is bound in it is compared with the others, and counts only where another one agrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.online.attempt import Picture
from morph_dslam.online.estimation.estimator import Estimator
from morph_dslam.online.measuring.binding import DrawnSurface, draw_view, view_of
from morph_dslam.online.reference.new_view import KEEP_OFF_PX, around
from morph_dslam.online.reference.reference_view import KnownView, ReferenceView
from morph_dslam.online.reference.surface_coverage import SurfaceSamples
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions

Array = NDArray[np.float64]

#: Another picture is taken as long as it adds this share of what all of them show, and at most so many are.
LEAST_GAIN, MOST_FURTHER = 0.03, 5


@dataclass(frozen=True)
class FurtherViews:
    """Other pictures of the object than the first.

    Attributes
    ----------
    causes : (d + 6, c) of the first view, as in `KnownView`; those of all are the same.
    """

    causes: Array | None
    views: tuple[KnownView, ...] = ()


def choose_further(
    estimator: Estimator, first: KnownView, others: Sequence[KnownView], options: TrackerOptions
) -> FurtherViews:
    """What to take beside the first view; nothing where the object shows too few corners in it."""
    chosen = _most_shown(estimator, [first, *others])
    try:
        agreed = _agreed(estimator, [first, *(others[k] for k in chosen)], [first, *others], options)
    except RegistrationError:
        agreed = [first]
    return FurtherViews(first.causes, tuple(agreed[1:]))


def _most_shown(estimator: Estimator, views: Sequence[KnownView]) -> list[int]:
    """Indices into ``views`` without the first, which is taken anyway; those that show most first."""
    drawn = DrawnSurface.of(estimator.model)
    surface, samples = drawn.model, SurfaceSamples(estimator, drawn)
    meshes = [view_of(surface, estimator.camera, view.state) for view in views]
    depths = [
        view.shown(draw_view(mesh, surface.triangles, estimator.camera))[1]
        for view, mesh in zip(views, meshes, strict=True)
    ]
    areas = np.abs([samples.seen(view.state, depth) for view, depth in zip(views, depths, strict=True)])
    # Of each sample the share of what the best picture shows of it.
    shares = areas / np.maximum(areas.max(axis=0), 1e-300)
    chosen, shown, possible = [], shares[0], shares.max(axis=0).sum()
    while len(chosen) < min(MOST_FURTHER, len(views) - 1) and possible > 0.0:
        gains = np.maximum(shares - shown, 0.0).sum(axis=1) / possible
        best = int(gains.argmax())
        if gains[best] < LEAST_GAIN:
            break
        chosen.append(best - 1)
        shown = np.maximum(shown, shares[best])
    return chosen


def _agreed(
    estimator: Estimator,
    views: Sequence[KnownView],
    pictures: Sequence[KnownView],
    options: TrackerOptions,
) -> list[KnownView]:
    """The views, each with what other ``pictures`` agree with in ``seen``."""
    reference, clock = ReferenceView(estimator, views, options), StageClock(("render", "correct"))
    agreed = np.zeros((len(pictures), len(reference.points)), dtype=bool)
    for row, picture in enumerate(pictures):
        agreed[row] = reference.measure(_as_frame(picture), picture.state, None, clock).valid
    result = [views[0]]
    for view, part in zip(views[1:], reference.parts[1:], strict=True):
        rows = [row for row, picture in enumerate(pictures) if picture is not view]
        alone = ~agreed[rows][:, part.rows].any(axis=0)
        if alone.all():
            continue
        places = estimator.camera.project(reference.points.in_camera(view.state)[part.rows][alone])
        seen = reference.covered(view.state) & ~around(view.picture, places, KEEP_OFF_PX)
        result.append(replace(view, seen=seen if view.seen is None else view.seen & seen))
    return result


def _as_frame(view: KnownView) -> Picture:
    """A view's picture, to be measured in; points do not count where something is before the object."""
    if view.seen is None:
        return view.picture
    return replace(view.picture, in_front=np.where(view.seen, np.float32(np.inf), np.float32(0.0)))
