"""Find the rubber's law from one notched specimen's force curve, and predict another specimen's force from its video.

    python examples/rubber_tension/identify.py --data DIR

Mooney and Rivlin's two constants are identified from the force curve of the specimen with long notches, up to a stroke
of 10 mm, before its crack grows. With them a model of the specimen with short notches is built and tracked in its
video. What is compared is its force on the clamp, by the stroke that the images show, with the measured one at the
stroke that the clamp had: it rests for 2.9 frames and then moves evenly by 0.1673 mm a frame, known to 1 %. Landmarks
leave the zero of the stroke open, by a few tenths of a millimetre where they are clicked carelessly, so that it is
counted from the pictures in which the clamp rests; how far the force is off without that is printed too.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from numpy.typing import NDArray
from run import OUTPUT, SPECIMENS, study, track
from specimen import Shape, write_mesh

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.identification import MeasuredForces, identification_lines, identify, write_identification
from morph_dslam.extend.reports import ForceCurve, load_curve, reaction_in_direction
from support import data_folder, keep

Array = NDArray[np.float64]
LEARNT, PREDICTED = "notch_7.2mm", "notch_3.6mm"
#: Longest stroke that counts, m, and strokes between which the prediction is compared.
SOUND, COMPARED = 10e-3, (2e-3, 16e-3)
#: First constant of the model whose moduli get one factor, Pa, and range of the second.
C10, C01 = 0.068e6, ["0.001 MPa", "0.12 MPa"]
#: Frames that the clamp rests, and its way in each that follows, m.
RESTS, SPEED = 2.9, 0.1673e-3
CLAMP = "left:-x"


def build(name: str, label: str, changes: dict[str, dict[str, Any]]) -> md.ReducedModel:
    """The model of a specimen with some sections of its study changed, built once."""
    OUTPUT.mkdir(exist_ok=True)
    mesh, recipe, model = (OUTPUT / f"{name}{end}" for end in (".inp", f"_{label}.json", f"_{label}.morph"))
    write_mesh(mesh, Shape(SPECIMENS[name].notch))
    content = study(mesh, SPECIMENS[name])
    for section, values in changes.items():
        content[section] = values if section in ("sampling", "reduction") else content[section] | values
    recipe.write_text(json.dumps(content, indent=1))
    keep(model, [mesh, recipe], lambda: md.build(md.make_study(content, OUTPUT), model))
    return md.load_model(model)


def rubber(c10: str, c01: str) -> dict[str, Any]:
    return {"rubber": {"law": "mooney_rivlin", "c10": c10, "c01": c01, "bulk": "22.6 MPa"}}


def constants(data: Path) -> tuple[float, float]:
    """Both constants, Pa, from the force curve of the specimen with long notches."""
    changes: dict[str, dict[str, Any]] = {
        "materials": rubber(f"{C10} Pa", "c01"),
        "parameters": {"c01": {"range": C01, "default": "0.045 MPa", "description": "second constant"}},
        "sampling": {"scheme": "grid", "points": [9, 4], "held_out": 4, "refined": 0},
        "reduction": {"method": "pod", "tolerance": 2e-4},
    }
    model = build(LEARNT, "law", changes)
    curve = load_curve(data / "force_stroke.csv", model, f"{LEARNT}_N")
    sound = curve.places <= SOUND
    forces = ForceCurve(curve.against, curve.places[sound], curve.forces[sound], curve.name)
    found = identify(model, [MeasuredForces(model, forces, reaction_in_direction(model, CLAMP))], ["c01"], moduli=True)
    for line in identification_lines(write_identification(OUTPUT / "identified", found)):
        print(line)
    factor = found["moduli_factor"].value
    return factor * C10, factor * found["c01"].value


def errors(run: md.Run, data: Path, from_rest: bool) -> tuple[Array, Array]:
    """Strokes (e,), m, of the tracked frames compared, and by how much their forces are off (e,), shares."""
    zero = run.parameters[run.tracked & (run.frames < RESTS)].mean(axis=0) if from_rest else np.zeros(1)
    curve = load_curve(data / "force_stroke.csv", run.model, f"{PREDICTED}_N")
    force = reaction_in_direction(run.model, CLAMP)
    strokes = np.asarray(SPEED * (run.frames - RESTS), dtype=np.float64)
    used = np.flatnonzero(run.tracked & (strokes >= COMPARED[0]) & (strokes <= COMPARED[1]))
    predicted = np.array([force(run.parameters[row] - zero) for row in used])
    missed = predicted / np.interp(strokes[used], curve.places, curve.forces) - 1.0
    return strokes[used], np.asarray(missed, dtype=np.float64)


def run(arguments: argparse.Namespace) -> None:
    video = arguments.data / f"{PREDICTED}.mp4"
    if not video.is_file():
        raise md.MorphError(f"there is no recording {video}: give the folder that holds it with --data")
    c10, c01 = constants(arguments.data)
    print(f"law of {LEARNT}: c10 = {1e-6 * c10:.4f} MPa, c01 = {1e-6 * c01:.4f} MPa")
    build(PREDICTED, "predicted", {"materials": rubber(f"{c10:.1f} Pa", f"{c01:.1f} Pa")})
    model, folder = OUTPUT / f"{PREDICTED}_predicted.morph", OUTPUT / f"run_{PREDICTED}_predicted"
    tracked = track(PREDICTED, SPECIMENS[PREDICTED], video, model, folder)
    (strokes, missed), (_, as_tracked) = (errors(tracked, arguments.data, from_rest) for from_rest in (True, False))
    for low in range(2, 16, 2):
        within = (strokes >= 1e-3 * low) & (strokes < 1e-3 * (low + 2))
        print(f"stroke {low} to {low + 2} mm: {100.0 * missed[within].mean():+.1f} %")
    print(
        f"c10_MPa={1e-6 * c10:.4f} c01_MPa={1e-6 * c01:.4f} mean_percent={100.0 * missed.mean():+.2f} "
        f"largest_percent={100.0 * missed[np.abs(missed).argmax()]:+.2f} frames={len(missed)} "
        f"not_from_rest_percent={100.0 * as_tracked[np.abs(as_tracked).argmax()]:+.2f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("rubber_tension"), help="folder of the recordings (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "what was built and tracked so far is kept")


if __name__ == "__main__":
    sys.exit(main())
