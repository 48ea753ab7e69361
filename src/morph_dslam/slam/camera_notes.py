"""What a reader of a run must know of its camera, in words."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from morph_dslam.slam.camera_terms import CameraEstimate, CameraTerm, TermEstimate


def camera_notes(
    estimate: CameraEstimate, deforms: bool = False, refined: Collection[CameraTerm] = ()
) -> Iterator[str]:
    """What a reader of a run must know of its camera, whose terms were all estimated.

    Parameters
    ----------
    estimate : of the camera
    deforms : whether it was estimated from an object whose deformation was estimated, too
    refined : terms that were estimated from the same recording before: they are not to be estimated once more
    """
    refuted: list[CameraTerm] = [
        term for term, found in estimate.terms.items() if found.is_wrong and found.is_observable
    ]
    contradicted = [f"{_NAMES[term]} {_described(term, estimate.terms[term])}" for term in refuted if term in refined]
    if contradicted:
        yield (
            f"the recording contradicts itself about the camera: {'; '.join(contradicted)}, although --refine-camera "
            "took the first value from it. Trust neither, and no lengths and angles of the map: calibrate the camera "
            "with a board (morph calibrate)"
        )
    wrong: list[CameraTerm] = [term for term in refuted if term not in refined]
    named = [f"{_NAMES[term]} {_described(term, estimate.terms[term])}" for term in wrong if term != "readout"]
    if named:
        yield (
            f"the camera file does not fit this recording: {'; '.join(named)}. Calibrate the camera again, or estimate "
            "it with morph slam --refine-camera"
        )
    if "readout" in wrong:
        yield (
            f"the camera has a rolling shutter: readout_s {_described('readout', estimate.terms['readout'])}. Write it "
            "into the camera file, or estimate it with morph slam --refine-camera readout"
            + (". It may be longer, because the estimated deformation takes up a part of what it does" * deforms)
        )
    hidden: list[CameraTerm] = [
        term for term, found in estimate.terms.items() if not found.is_observable and term != "readout"
    ]
    if hidden and not any(np.isfinite(estimate.terms[term].departure_std) for term in hidden):
        yield "this recording cannot check the camera file: too few of its frames share enough points"
    elif hidden:
        named = [f"{_NAMES[term]} {_described(term, estimate.terms[term])}" for term in hidden]
        unlikely = " and ".join(_NAMES[term] for term in hidden if estimate.terms[term].is_wrong)
        yield (
            f"this recording cannot check the camera file: unobservable here: {'; '.join(named)}"
            + f". Check it all the same: the given {unlikely} is unlikely" * bool(unlikely)
        )


def known_map_notes(estimate: CameraEstimate) -> Iterator[str]:
    """What a reader of a run in a known map must know of its lens, which alone was estimated.

    Intrinsics are those of the map, and what deforms in a map that is kept looks like another focal length or readout
    time.
    """
    lens = estimate.terms.get("radial")
    if lens is not None and lens.is_wrong and lens.is_observable:
        yield (
            f"the camera file does not fit this recording: {_NAMES['radial']} {_described('radial', lens)}. "
            "Positions are wrong by more than they state. Give the camera of this recording, or the pictures of this "
            "camera: undistorted ones where it has no distortion, as that of a COLMAP model"
        )


_NAMES: dict[CameraTerm, str] = {
    "focal": "focal length",
    "centre": "principal point",
    "radial": "lens distortion k1, k2",
    "tangential": "lens distortion p1, p2",
    "readout": "readout_s",
}


def _described(term: CameraTerm, found: TermEstimate) -> str:
    """Given and estimated values, with two standard deviations."""
    unit, digits = (" px", 1) if term in ("focal", "centre") else (" s" if term == "readout" else "", 4)
    intervals = zip(found.estimated, found.std, strict=True)
    given = ", ".join(f"{value:.{digits}f}" for value in found.given)
    shown = ", ".join(f"{value:.{digits}f} ± {2.0 * std:.{digits}f}" for value, std in intervals)
    return f"{given}{unit}, by the recording {shown}{unit} (95 %)"
