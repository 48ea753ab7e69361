"""Pixel error: points followed in the images of one camera, against where a run has them.

A track is bound to the material point that its pixel shows in one frame. Where this point is in another frame the run
says in space; the camera says in which pixel of the recorded image that is. Truth of one camera says nothing of the
error along the sight line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.points import OUTLINE_TOLERANCE_PX, bind_pixels, millimetres
from morph_dslam.evaluation.rolling_shutter import RecordedNodes
from morph_dslam.evaluation.run_folder import Run, frames_in_words
from morph_dslam.io.text import read_csv
from morph_dslam.model import SurfacePoints

Array = NDArray[np.float64]
HEADER = ("frame", "id", "u", "v")
#: No frame and no pixel is meant by what is larger.
LARGEST = 1e7


@dataclass(frozen=True)
class PixelTracks:
    """Points followed in images.

    Attributes
    ----------
    ids : (p,) names of the tracks.
    frames : (t,) frame numbers, ascending.
    pixels : (t, p, 2) in the images as recorded (with lens distortion); NaN where a track was not measured.
    """

    ids: tuple[str, ...]
    frames: NDArray[np.int64]
    pixels: Array


def load_tracks(path: str | Path) -> PixelTracks:
    """Read tracks: CSV with a first line ``frame,id,u,v``, then a line for each measurement.

    Columns may stand in any order, and others are not read. A line whose u or v is empty or NaN says that the track was
    not measured.

    Raises
    ------
    EvaluationError
        If the file is missing, lacks a column or a measurement, or a line has no frame, no id or no numbers, or names
        a track for the second time in a frame.
    """
    (_, header), *rows = read_csv(Path(path), "tracks", EvaluationError) or [(1, [])]
    if missing := [name for name in HEADER if name not in header]:
        raise EvaluationError(f"{path} has no column {', '.join(missing)}; its first line must name {','.join(HEADER)}")
    columns = [header.index(name) for name in HEADER]
    measured: dict[tuple[int, str], tuple[float, float]] = {}
    for line, row in rows:
        where = f"{path}, line {line}"
        if any(row[len(header) :]):
            raise EvaluationError(f"{where}: more cells than the {len(header)} titles; write decimals with points")
        frame, name, u, v = _measurement(where, row, columns)
        if (frame, name) in measured:
            raise EvaluationError(f"{where}: track '{name}' occurs twice in frame {frame}")
        measured[frame, name] = u, v
    if not np.isfinite(list(measured.values())).any():
        raise EvaluationError(f"{path} holds no measurement: give a line for each track in each frame")
    return _gathered(measured)


def _measurement(where: str, row: Sequence[str], columns: Sequence[int]) -> tuple[int, str, float, float]:
    try:
        frame, name, u, v = (row[column] for column in columns)
        values = int(frame), name, float(u or "nan"), float(v or "nan")
    except (ValueError, IndexError):
        values = -1, "", 0.0, 0.0
    if not values[1] or not 0 <= values[0] < LARGEST or (np.abs(values[2:]) > LARGEST).any():
        raise EvaluationError(f"{where}: '{','.join(row)}' is not a frame number, an id and two pixel coordinates")
    return values


def _gathered(measured: Mapping[tuple[int, str], tuple[float, float]]) -> PixelTracks:
    ids = list(dict.fromkeys(name for _, name in measured))
    frames = sorted({frame for frame, _ in measured})
    rows, columns = ({key: i for i, key in enumerate(keys)} for keys in (frames, ids))
    pixels = np.full((len(frames), len(ids), 2), np.nan)
    for (frame, name), pixel in measured.items():
        pixels[rows[frame], columns[name]] = pixel
    return PixelTracks(tuple(ids), np.array(frames, dtype=np.int64), pixels)


@dataclass(frozen=True)
class PixelError:
    """Errors of the tracks that could be bound, b of them.

    Attributes
    ----------
    ids : (b,) names of the tracks.
    points : where they are on the mesh, length b.
    bind_frames : (b,) the frames whose pixels bound them.
    frames : (e,) the frames compared.
    pixels : (e, b, 2) estimated minus measured pixel, recorded image; NaN where a track was not measured, and where
        it was bound.
    across : (e, b) distance of the estimated point from the measured sight line, metres.
    n_outline : how many tracks missed the surface by at most `OUTLINE_TOLERANCE_PX`.
    off_surface : names of tracks that missed it by more.
    never : names of tracks without a measurement in the frames in which they could be bound.
    untracked : frames of the tracks that the run has but did not track.
    outside : frames of the tracks that it does not have.
    """

    ids: tuple[str, ...]
    points: SurfacePoints
    bind_frames: NDArray[np.int64]
    frames: NDArray[np.int64]
    pixels: Array
    across: Array
    n_outline: int
    off_surface: tuple[str, ...]
    never: tuple[str, ...]
    untracked: tuple[int, ...]
    outside: tuple[int, ...]

    @property
    def distances_px(self) -> Array:
        """Length (e, b) of the error in the image, pixels."""
        return np.linalg.norm(self.pixels, axis=2)


def pixel_error(run: Run, tracks: PixelTracks, bind_frame: int | None = None) -> PixelError:
    """Bind each track and compare it in all other frames that the run tracked.

    Parameters
    ----------
    bind_frame : the frame that binds all tracks; where absent, for each the first in which it was measured and the run
        tracked the object.
    """
    rows = {frame: run.row(frame) for frame in tracks.frames.tolist()}
    outside = tuple(frame for frame, row in rows.items() if row is None)
    untracked = tuple(frame for frame, row in rows.items() if row is not None and not run.tracked[row])
    known = np.array([frame not in outside and frame not in untracked for frame in rows], dtype=bool)
    frames, recorded = tracks.frames[known], tracks.pixels[known]
    seen = np.isfinite(recorded[..., 0]) & np.isfinite(recorded[..., 1])
    starts = _starts(run, frames, seen, bind_frame)
    nodes = RecordedNodes(run)
    points, n_outline = _bind(run, nodes, frames, recorded, starts)
    bound = points.triangles >= 0
    columns = np.flatnonzero(bound)
    if not columns.size:
        raise EvaluationError(_nothing_bound(starts, untracked, outside))
    seen[starts[columns], columns] = False
    compared = np.flatnonzero(seen[:, columns].any(axis=1))
    if not compared.size:
        raise EvaluationError(
            "no track was measured in a second frame that can be compared: "
            f"not tracked {frames_in_words(untracked)}, outside the run {frames_in_words(outside)}"
        )
    points = points.take(columns)
    masked = np.where(seen[..., None], recorded, np.nan)[:, columns]
    errors = [
        _in_frame(run, nodes, frame, points, masked[i]) for i, frame in enumerate(frames.tolist()) if i in compared
    ]
    names = np.array(tracks.ids, dtype=object)
    return PixelError(
        ids=tuple(names[columns]),
        points=points,
        bind_frames=frames[starts[columns]],
        frames=frames[compared],
        pixels=np.array([pixels for pixels, _ in errors]),
        across=np.array([across for _, across in errors]),
        n_outline=n_outline,
        off_surface=tuple(names[~bound & (starts >= 0)]),
        never=tuple(names[starts < 0]),
        untracked=untracked,
        outside=outside,
    )


def _starts(run: Run, frames: NDArray[np.int64], seen: NDArray[np.bool_], bind_frame: int | None) -> NDArray[np.int64]:
    """Which of the ``frames`` (e,) binds each track (p,), -1 for none; ``seen`` (e, p) is where they were measured."""
    if bind_frame is None:
        return np.where(seen.any(axis=0), seen.argmax(axis=0), -1) if len(seen) else np.full(seen.shape[1], -1)
    found = np.flatnonzero(frames == bind_frame)
    if not found.size or not seen[found[0]].any():
        row, measured = run.row(bind_frame), frames_in_words(frames[seen.any(axis=1)])
        why = f"no track is measured in frame {bind_frame}"
        if row is None:
            why = f"frame {bind_frame} is not in the run"
        elif not run.tracked[row]:
            why = f"frame {bind_frame} was not tracked ({run.reasons[row]})"
        raise EvaluationError(
            f"{why}: bind in a frame that was tracked and has measurements ({measured}), or leave --bind-frame out"
        )
    return np.where(seen[found[0]], found[0], -1)


def _bind(
    run: Run, nodes: RecordedNodes, frames: NDArray[np.int64], recorded: Array, starts: NDArray[np.int64]
) -> tuple[SurfacePoints, int]:
    """The material points (p) of tracks, triangle -1 where there is none, and how many are bound to the outline."""
    triangles, weights = np.full(len(starts), -1, dtype=np.int64), np.zeros((len(starts), 3))
    n_outline = 0
    for start in np.unique(starts[starts >= 0]):
        columns = np.flatnonzero(starts == start)
        row = run.row(int(frames[start]))
        assert row is not None
        points, n_near = bind_pixels(run, row, recorded[start, columns], nodes.points(row))
        triangles[columns], weights[columns] = points.triangles, points.weights
        n_outline += n_near
    return SurfacePoints(triangles, weights), n_outline


def _nothing_bound(starts: NDArray[np.int64], untracked: Sequence[int], outside: Sequence[int]) -> str:
    if (starts < 0).all():
        return (
            "no track was measured in a frame in which it could be bound: "
            f"not tracked {frames_in_words(untracked)}, outside the run {frames_in_words(outside)}"
        )
    return (
        "no track begins on the estimated surface: are its pixels those of the recorded images, with (0, 0) the "
        "centre of the first pixel?"
    )


def _in_frame(
    run: Run, nodes: RecordedNodes, frame: int, points: SurfacePoints, recorded: Array
) -> tuple[Array, Array]:
    """Errors in pixels (b, 2) and across the sight line (b,), metres, of tracks at ``recorded`` pixels (b, 2)."""
    row = run.row(frame)
    assert row is not None
    corners = run.model.triangles[points.triangles]
    predicted = np.einsum("bc,bcx->bx", points.weights, nodes.points(row)[corners])
    sight = run.camera.rays(run.camera.undistort_pixels(recorded))
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    along = np.einsum("bx,bx->b", predicted, sight)
    across = np.linalg.norm(predicted - along[:, None] * sight, axis=1)
    return run.camera.project_recorded(predicted) - recorded, across


#: Tracks that the report names because they err most.
N_WORST = 10


def _figures(error: PixelError, part: tuple[slice, slice]) -> dict[str, float]:
    pixels = error.distances_px[part]
    return {
        "mean_px": float(np.nanmean(pixels)),
        "median_px": float(np.nanmedian(pixels)),
        "p95_px": float(np.nanpercentile(pixels, 95)),
        "max_px": float(np.nanmax(pixels)),
        **millimetres(error.across[part]),
    }


def summarise_pixels(error: PixelError) -> dict[str, Any]:
    """The figures of ``pixel_evaluation.json``, plain JSON."""
    measured = np.isfinite(error.distances_px)
    everything = slice(None)
    per_track = {
        name: {
            "bind_frame": int(error.bind_frames[b]),
            "n_frames": int(measured[:, b].sum()),
            **_figures(error, (everything, slice(b, b + 1))),
        }
        for b, name in enumerate(error.ids)
        if measured[:, b].any()
    }
    return {
        **_figures(error, (everything, everything)),
        "mean_shift_px": np.nanmean(error.pixels, axis=(0, 1)).tolist(),
        "n_tracks": len(error.ids) + len(error.off_surface) + len(error.never),
        "n_tracks_compared": len(per_track),
        "n_tracks_bound_at_outline": error.n_outline,
        "outline_tolerance_px": OUTLINE_TOLERANCE_PX,
        "tracks_off_the_surface": list(error.off_surface),
        "tracks_not_measured_where_bound": list(error.never),
        "tracks_bound_but_never_compared": [name for name in error.ids if name not in per_track],
        "n_comparisons": int(measured.sum()),
        "frames_compared": error.frames.tolist(),
        "track_frames_not_tracked": list(error.untracked),
        "track_frames_outside_the_run": list(error.outside),
        "worst_tracks": sorted(per_track, key=lambda name: -per_track[name]["mean_px"])[:N_WORST],
        "per_frame": {
            str(frame): _figures(error, (slice(row, row + 1), everything))
            for row, frame in enumerate(error.frames.tolist())
        },
        "per_track": per_track,
    }


def pixel_remarks(figures: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures must know: tracks and frames that could not be compared."""
    n_tracks, lines = figures["n_tracks"], []
    if frames := figures["track_frames_not_tracked"]:
        lines.append(f"frames of the tracks that the run did not track and that were not compared: {frames}")
    if frames := figures["track_frames_outside_the_run"]:
        lines.append(f"frames of the tracks that are outside the run: {frames}")
    reasons = {
        "tracks_off_the_surface": "begin off the estimated surface",
        "tracks_not_measured_where_bound": "were not measured in a frame that could bind them",
        "tracks_bound_but_never_compared": "were measured in no second frame that was tracked",
    }
    for key, reason in reasons.items():
        if names := figures[key]:
            some = ", ".join(names[:N_WORST]) + (" ..." if len(names) > N_WORST else "")
            lines.append(f"{len(names)} of {n_tracks} tracks {reason}, and were not compared: {some}")
    if figures["n_tracks_bound_at_outline"]:
        lines.append(
            f"{figures['n_tracks_bound_at_outline']} tracks missed the surface by up to "
            f"{figures['outline_tolerance_px']:g} px and were bound to its outline"
        )
    return [*lines, *figures.get("notes", [])]


def pixel_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against tracks; millimetres are across the sight line."""
    return (
        f"mean_px={figures['mean_px']:.3f} p95_px={figures['p95_px']:.3f} mean_mm={figures['mean_mm']:.4f} "
        f"p95_mm={figures['p95_mm']:.4f} tracks={figures['n_tracks_compared']} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']}"
    )
