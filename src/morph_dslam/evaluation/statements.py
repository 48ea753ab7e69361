"""The figures of an evaluation in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def remarks(figures: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures must know: truth that could not be compared."""
    lines = []
    if figures["truth_frames_not_tracked"]:
        lines.append(
            f"truth frames that were not tracked and so not compared: {figures['truth_frames_not_tracked']}"
        )
    if figures["truth_frames_outside_the_run"]:
        lines.append(f"truth frames outside the run: {figures['truth_frames_outside_the_run']}")
    if figures["points_not_bound"]:
        unseen = figures["n_points_unseen"]
        off = len(figures["points_not_bound"]) - unseen
        why = [f"{unseen} are hidden or not measured"] * bool(unseen)
        why += [f"{off} fall off the estimated surface"] * bool(off)
        lines.append(
            f"of {figures['n_points']} truth points {' and '.join(why)} in frame {figures['bind_frame']}: "
            "these were not compared"
        )
    if figures["n_points_bound_at_outline"]:
        lines.append(
            f"{figures['n_points_bound_at_outline']} truth points missed the surface by up to "
            f"{figures['outline_tolerance_px']:g} px and were bound to its outline"
        )
    return lines


def alignment_line(figures: Mapping[str, Any]) -> str:
    """How much of the error is one rigid motion between truth and estimate, as commands print it."""
    together, single = figures["after_one_rigid_motion"], figures["after_one_in_each_frame"]
    turn = ", ".join(f"{angle:.2f}" for angle in together["rotation_deg"])
    return (
        f"after one rigid motion of all truth points (rotation {turn} degrees about x, y, z): mean "
        f"{together['mean_mm']:.3f} mm, median {together['median_mm']:.3f} mm; after one in each frame: mean "
        f"{single['mean_mm']:.3f} mm, median {single['median_mm']:.3f} mm"
    )


def result_line(figures: Mapping[str, Any]) -> str:
    """The last line that commands and examples print."""
    return (
        f"mean_mm={figures['mean_mm']:.3f} median_mm={figures['median_mm']:.3f} "
        f"p95_mm={figures['p95_mm']:.3f} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']} "
        f"median_ms={figures['median_ms']:.2f} p95_ms={figures['p95_ms']:.2f}"
    )


def depth_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against depth images."""
    base = figures["base"]
    beside = f" base_mean_mm={base['mean_mm']:.3f}" if base and base["n_points"] else ""
    return (
        f"surface_mean_mm={figures['mean_mm']:.3f} surface_median_mm={figures['median_mm']:.3f} "
        f"surface_p95_mm={figures['p95_mm']:.3f}{beside} left_out_percent={figures['left_out_percent']:.1f} "
        f"frames={len(figures['frames_compared'])}/{figures['n_frames']}"
    )
