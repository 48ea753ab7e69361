"""Experiments: what the examples have in common, from a study to the line that says how well it went."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morph_dslam._version import __version__

FrameRange = tuple[int | None, int | None]


def keep(product: Path, ingredients: Sequence[Path], make: Callable[[], object]) -> bool:
    """Make ``product`` unless it was already made from the same ingredients.

    Parameters
    ----------
    product : a file or folder that ``make`` writes.
    ingredients : files whose contents decide whether it must be made anew.

    Returns
    -------
    Whether it was made.
    """
    digest = hashlib.sha256(__version__.encode())
    for path in ingredients:
        digest.update(path.read_bytes())
    recipe, wanted = product.with_name(product.name + ".made-from"), digest.hexdigest()
    if product.exists() and recipe.is_file() and recipe.read_text() == wanted:
        print(f"using {product}")
        return False
    product.parent.mkdir(parents=True, exist_ok=True)
    recipe.unlink(missing_ok=True)
    make()
    recipe.write_text(wanted)
    return True


def keep_model(study: Path, model: Path) -> None:
    """Build a model once; it is built again when the study or the release changes."""
    from morph_dslam.studies.build import build

    keep(model, [study], lambda: build(study, model))


def keep_sequence(scene: Path, model: Path, folder: Path) -> None:
    """Film a model once; it is filmed again when the scene, the model or the release changes.

    Raises
    ------
    SceneError
        If there is no such scene, or it cannot be filmed.
    """
    from morph_dslam.errors import SceneError
    from morph_dslam.render.simulation import simulate

    if not scene.is_file():
        raise SceneError(f"there is no scene file {scene}: give the path of one that is there")
    keep(folder, [scene, model], lambda: simulate(scene, folder))


@dataclass(frozen=True)
class Recording:
    """A sequence with truth.

    Attributes
    ----------
    frames : video file or folder of images. camera, landmarks, truth : files. range : frames to track.
    reference_frame : the frame that the landmarks belong to; the first one tracked by default.
    refine_reference : refine the reference state over the sequence; for landmarks set by hand.
    use_outline : let the outline count; for surfaces with bare margins.
    use_discrepancy : look for what the shape has beyond the model's.
    """

    frames: Path
    camera: Path
    landmarks: Path
    truth: Path
    range: FrameRange = (None, None)
    reference_frame: int | None = None
    refine_reference: bool = False
    use_outline: bool = False
    use_discrepancy: bool = False


def first_truth_frame(recording: Recording) -> int:
    """The first frame of the range that has truth; there the truth points are bound.

    Raises
    ------
    EvaluationError
        If the range holds no frame with truth, or the truth file cannot be read.
    """
    from morph_dslam.errors import EvaluationError
    from morph_dslam.evaluation.points import load_truth

    first, last = recording.range
    frames = sorted(load_truth(recording.truth).frames.tolist())
    inside = [f for f in frames if (first is None or f >= first) and (last is None or f <= last)]
    if not inside:
        raise EvaluationError(f"{recording.truth} has no frame in the range tracked; it has {frames}")
    return inside[0]


def check_recording(recording: Recording) -> None:
    """Find mistakes in a recording before anything long begins.

    Raises
    ------
    MorphError
        If a file is missing or malformed, or the range does not fit the frames or the truth.
    """
    from morph_dslam.io.camera_files import load_camera
    from morph_dslam.io.tables import load_landmarks
    from morph_dslam.sources import open_source

    open_source(recording.frames, *recording.range)
    load_camera(recording.camera)
    load_landmarks(recording.landmarks)
    first_truth_frame(recording)


def track_and_evaluate(recording: Recording, model: Path, run: Path) -> dict[str, Any]:
    """Track a recording and compare it with its truth.

    Returns
    -------
    The figures of ``evaluation.json``.
    """
    from morph_dslam.evaluation.evaluate import evaluate
    from morph_dslam.tracking.track import TrackOptions, track

    bind_frame = first_truth_frame(recording)
    first, last = recording.range
    track(
        TrackOptions(
            frames=recording.frames,
            model=model,
            camera=recording.camera,
            landmarks=recording.landmarks,
            output=run,
            first=first,
            last=last,
            reference_frame=recording.reference_frame,
            refine_reference=recording.refine_reference,
            use_outline=recording.use_outline,
            use_discrepancy=recording.use_discrepancy,
            overwrite=True,
        )
    )
    return evaluate(run, recording.truth, bind_frame)


def report(figures: dict[str, Any], run: Path) -> None:
    """Print where the results are and, last, the result line."""
    from morph_dslam.evaluation.run_folder import alignment_line, remarks, result_line

    for remark in remarks(figures):
        print(f"note: {remark}")
    print(f"video   {run / 'augmented.mp4'}")
    print(f"report  {run / 'report.html'}")
    print(alignment_line(figures))
    print(result_line(figures))
