"""Fit the modulus of a real silicone beam to its own weight and predict how far two loads bend it.

    python examples/silicone_beam/run.py --data DIR

A beam of Dragon Skin 10 (30 x 30 x 100 mm) is clamped at one end. Motion capture measured three markers at its tip
while it was held straight, let go, and came to rest: under its own weight, with 52 g and with 101 g at the tip, each
twice. The recordings (Soft Robotics Lab, ETH Zurich, with diffPD_sim2real) are not part of the project.

The model has the modulus and the hung weight as parameters. The modulus alone is fitted, to the two recordings of own
weight; the four others are predicted. What is compared is the fall of the markers, resting minus held, as measured.
A hand held the beam, so repetitions differ by up to 0.7 mm. The markers lie in the plane of the tip's face, as the
recordings' authors have it in their program. `identify` finds the modulus; errors within a recording count as one.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib
import numpy as np
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.identification import Estimate, MeasuredPoints, identify
from support import data_folder, keep_model

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
STUDY, OUTPUT = HERE / "study.toml", HERE / "output"
#: Mass hung in each state, kg, and the repetitions of each.
MASSES, REPETITIONS = {"gravity": 0.0, "load52": 0.052, "load101": 0.101}, "ab"
FITTED = "gravity"
GRAVITY, LENGTH, SIDE, DENSITY = 9.81, 0.1, 0.03, 1070.0
#: Rows in which the beam is held, and those in which it is at rest.
HELD_ROWS, RESTING_ROWS = 3, 50
#: The middle of the topmost marker is so far above the beam's axis, m: the markers' places across it hardly matter.
TOP_MARKER = 0.021


@dataclass(frozen=True)
class Markers:
    """Where a recording has the tip's markers.

    Attributes
    ----------
    state : key of `MASSES`.
    name : of the file.
    held : (3, 3) while the beam is held, m, x upwards, z along the beam.
    resting : (3, 3) likewise, at rest.
    """

    state: str
    name: str
    held: Array
    resting: Array

    @property
    def way(self) -> Array:
        """How far (3, 3), m, the markers went."""
        return self.resting - self.held

    @property
    def fall(self) -> float:
        """By how much the markers sink, m."""
        return -float(self.way[:, 0].mean())

    @property
    def places(self) -> Array:
        """Where the held markers are on the model's beam (3, 3), m."""
        top = self.held[self.held[:, 0].argmax()]
        return np.column_stack([self.held[:, :2] - top[:2] + [SIDE / 2 + TOP_MARKER, SIDE / 2], np.full(3, LENGTH)])


def read_markers(folder: Path, state: str, repetition: str) -> Markers:
    """One recording; raises MorphError if it cannot be read."""
    path = folder / f"{state}_{repetition}.csv"
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise md.MorphError(f"{path} cannot be read as time and markers' coordinates: {error}") from error
    if rows.shape[1] < 10 or len(rows) < RESTING_ROWS + HELD_ROWS:
        raise md.MorphError(f"{path} has {rows.shape} numbers: time and three markers in more than 50 rows are needed")
    tip = 1e-3 * rows[:, 1:10].reshape(-1, 3, 3)
    return Markers(state, path.stem, tip[:HELD_ROWS].mean(axis=0), tip[-RESTING_ROWS:].mean(axis=0))


class Beam:
    """The reduced model of the beam, with the markers at its tip."""

    def __init__(self, model: md.ReducedModel) -> None:
        self.model = model

    def table(self, recordings: list[Markers]) -> MeasuredPoints:
        """The markers at rest, as points of the beam; by the way that each went while it was let go."""
        rows = [(each, place, way) for each in recordings for place, way in zip(each.places, each.way, strict=True)]
        return MeasuredPoints(
            self.model,
            states=tuple(each.name for each, _, _ in rows),
            known={"load": np.array([GRAVITY * MASSES[each.state] for each, _, _ in rows])},
            places=np.array([place for _, place, _ in rows]),
            measured=np.array([place + way for _, place, way in rows]),
        )

    def motion(self, modulus: float, markers: Markers) -> Array:
        """How far (3, 3), m, the model moves the markers."""
        table = self.table([markers])
        return table.positions(lambda known: self.model.vector({**known, "modulus": modulus})) - markers.places

    def fall(self, modulus: float, markers: Markers) -> float:
        """By how much the markers sink, m."""
        return -float(self.motion(modulus, markers)[:, 0].mean())

    def identified(self, recordings: list[Markers]) -> Estimate:
        """The modulus with its interval."""
        return identify(self.model, [self.table(recordings)], ["modulus"])["modulus"]


def beam_theory(recordings: list[Markers]) -> float:
    """The modulus, Pa, by which a slender beam with small motions would sink as far under its own weight."""
    weight = DENSITY * SIDE**2 * LENGTH * GRAVITY
    fall = float(np.mean([each.fall for each in recordings]))
    return weight * LENGTH**3 / (8.0 * SIDE**4 / 12.0 * fall)


def _stated(modulus: Estimate) -> str:
    low, high = modulus.interval
    return f"{modulus.value / 1e3:.1f} kPa (95 % interval {low / 1e3:.0f} to {high / 1e3:.0f})"


def plot(beam: Beam, recordings: list[Markers], moduli: dict[str, float], path: Path) -> None:
    """Draw the falls measured, and those of the model over the mass hung."""
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    masses = sorted(MASSES.items(), key=lambda pair: pair[1])
    for label, modulus in moduli.items():
        falls = [
            np.mean([beam.fall(modulus, each) for each in recordings if each.state == state]) for state, _ in masses
        ]
        grams = [1e3 * mass for _, mass in masses]
        axes.plot(grams, 1e3 * np.array(falls), "-o", markersize=3, label=f"{label}, {modulus / 1e3:.0f} kPa")
    masses_hung, falls = np.array([(MASSES[each.state], each.fall) for each in recordings]).T
    axes.plot(1e3 * masses_hung, 1e3 * falls, "k+", markersize=11, label="measured")
    axes.set(xlabel="mass hung at the tip, g", ylabel="fall of the tip's markers, mm", title="Silicone beam")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def run(arguments: argparse.Namespace) -> None:
    recordings = [read_markers(arguments.data, state, repetition) for state in MASSES for repetition in REPETITIONS]
    OUTPUT.mkdir(exist_ok=True)
    keep_model(STUDY, OUTPUT / "beam.morph")
    beam = Beam(md.load_model(OUTPUT / "beam.morph"))
    fitted_to = [each for each in recordings if each.state == FITTED]
    by_weight, by_all = beam.identified(fitted_to), beam.identified(recordings)
    modulus, of_all = by_weight.value, by_all.value
    print(f"modulus by own weight alone {_stated(by_weight)}, by beam theory {beam_theory(fitted_to) / 1e3:.1f} kPa")
    print(f"modulus that fits all recordings best {_stated(by_all)}")
    print("recording    measured mm  predicted mm  error %   with the modulus of all  error %")
    errors: dict[str, list[float]] = {state: [] for state in MASSES}
    for each in recordings:
        fall, other = beam.fall(modulus, each), beam.fall(of_all, each)
        errors[each.state].append(100.0 * (fall / each.fall - 1.0))
        print(
            f"{each.name:12s} {1e3 * each.fall:11.2f} {1e3 * fall:13.2f} {errors[each.state][-1]:+8.1f} "
            f"{1e3 * other:25.2f} {100.0 * (other / each.fall - 1.0):+8.1f}"
        )
    plot(beam, recordings, {"fitted to own weight": modulus, "fitted to all": of_all}, OUTPUT / "falls.png")
    print(f"plot    {OUTPUT / 'falls.png'}")
    misses = [beam.motion(modulus, each) - each.way for each in fitted_to]
    largest = {state: max(values, key=abs) for state, values in errors.items()}
    print(
        f"modulus_kPa={modulus / 1e3:.1f} fit_mm={1e3 * np.linalg.norm(misses, axis=2).mean():.2f} "
        f"load52_percent={largest['load52']:.1f} load101_percent={largest['load101']:.1f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder("silicone_beam"), help="the recordings' folder")
    return run_and_report_errors(run, parser.parse_args(), "the model built so far is kept")


if __name__ == "__main__":
    sys.exit(main())
