"""What the examples have in common: products that are kept, and a recording with its truth.

Each example adds the folder of this file to the path that Python imports from.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import morph_dslam as md
from morph_dslam.extend.registration import Landmarks, load_landmarks, save_landmarks
from morph_dslam.extend.reports import alignment_line, load_truth, remarks, result_line


def data_folder(name: str) -> Path:
    """Where measurements that are not part of the project are looked for: under $MORPH_DATA, or beside the project."""
    return Path(os.environ.get("MORPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / name


def keep(product: Path, ingredients: Sequence[Path], make: Callable[[], object]) -> bool:
    """Make ``product`` unless it was already made from the same ingredients.

    Parameters
    ----------
    product : a file or folder that ``make`` writes
    ingredients : files whose contents decide whether it must be made anew
    make : writes the product

    Returns
    -------
    bool
        Whether it was made.
    """
    digest = hashlib.sha256(md.__version__.encode())
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
    keep(model, [study], lambda: md.build(study, model))


def keep_sequence(scene: Path, model: Path, folder: Path, progress: bool = True) -> None:
    """Film a model once; it is filmed again when the scene, the model or the release changes.

    Raises
    ------
    MorphError
        If there is no such scene, or it cannot be filmed.
    """
    if not scene.is_file():
        raise md.MorphError(f"there is no scene file {scene}: give the path of one that is there")
    keep(folder, [scene, model], lambda: md.simulate(scene, folder, progress=progress))


@dataclass(frozen=True)
class Recording:
    """A sequence with truth.

    Attributes
    ----------
    frames : folder of images, or video
    camera : camera file
    landmarks : landmarks file
    truth : truth file
    range : first and last frame to track
    reference_frame : the frame that the landmarks belong to; the first one tracked by default
    refine_reference : refine the reference state over the sequence; for landmarks set by hand
    snap : correct the landmarks by the outline in their frame
    use_outline : use the outline too; for surfaces with bare margins
    use_discrepancy : estimate what the shape has beyond the model's
    """

    frames: Path
    camera: Path
    landmarks: Path
    truth: Path
    range: tuple[int | None, int | None] = (None, None)
    reference_frame: int | None = None
    refine_reference: bool = False
    snap: bool = False
    use_outline: bool = False
    use_discrepancy: bool = False

    @property
    def first_truth_frame(self) -> int:
        """The first frame of the range that has truth; there the truth points are bound to the model.

        Raises
        ------
        MorphError
            If the range holds no frame with truth, or the truth file cannot be read.
        """
        first, last = self.range
        frames = sorted(load_truth(self.truth).frames.tolist())
        inside = [f for f in frames if (first is None or f >= first) and (last is None or f <= last)]
        if not inside:
            raise md.MorphError(f"{self.truth} has no frame in the range tracked; it has {frames}")
        return inside[0]


def clicked(landmarks: Path, output: Path, noise_px: float) -> Path:
    """Write landmarks as a hand sets them: each pixel coordinate off by this standard deviation; returns the file."""
    exact = load_landmarks(landmarks)
    noise = noise_px * np.random.default_rng(0).standard_normal(exact.pixels.shape)
    save_landmarks(output, Landmarks(exact.points, exact.pixels + noise))
    return output


def check_recording(recording: Recording) -> None:
    """Find mistakes in a recording before anything long begins; raises MorphError."""
    md.open_source(recording.frames, *recording.range)
    md.load_camera(recording.camera)
    load_landmarks(recording.landmarks)
    recording.first_truth_frame  # noqa: B018


def track_and_evaluate(recording: Recording, model: Path, run: Path) -> dict[str, Any]:
    """Track a recording into a run folder and compare it with its truth; returns the figures of ``evaluation.json``."""
    bind_frame = recording.first_truth_frame
    first, last = recording.range
    md.track(
        md.TrackOptions(
            frames=recording.frames,
            model=model,
            camera=recording.camera,
            landmarks=recording.landmarks,
            output=run,
            first=first,
            last=last,
            reference_frame=recording.reference_frame,
            refine_reference=recording.refine_reference,
            snap=recording.snap,
            tracker=md.TrackerOptions(use_outline=recording.use_outline, use_discrepancy=recording.use_discrepancy),
            overwrite=True,
        )
    )
    return md.evaluate(run, recording.truth, bind_frame)


def report(figures: dict[str, Any], run: Path) -> None:
    """Print where the results are and, last, the result line."""
    for remark in remarks(figures):
        print(f"note: {remark}")
    print(f"video   {run / 'augmented.mp4'}")
    print(f"report  {run / 'report.html'}")
    print(alignment_line(figures))
    print(result_line(figures))
