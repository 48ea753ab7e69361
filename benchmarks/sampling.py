"""A model of one parameter by default sampling, beside one of 256 scattered solutions and 59 held-out ones.

A bellows of 7 872 nodes is turned by up to 52 degrees and pulled by up to 5 mm at once. Both builds solve the same
elements without an estimate of the discretisation error; errors are those of the held-out solutions of each.
Run: python benchmarks/sampling.py
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import morph_dslam as md
from discretisation import bellows

DIVISIONS = (81, 2, 32)
PULL = "5 mm * lever / 52 deg"
SCATTERED = {"scheme": "sobol", "training": 256, "held_out": 59}


def build(sampling: dict[str, Any]) -> tuple[dict[str, Any], float]:
    """The certificate, and the seconds that the build took."""
    study = bellows(DIVISIONS, PULL, sampling | {"refined": 0})
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        certificate = md.build(study, Path(folder) / "bellows.morph").certificate
        return certificate, time.perf_counter() - begin


def main() -> None:
    kinds = {"default": build({}), "scattered": build(SCATTERED)}
    print("| sampling | solves | mean mm | largest mm | von Mises, relative | s |\n|---|---|---|---|---|---|")
    for name, (certificate, seconds) in kinds.items():
        error, stress = certificate["displacement"], certificate["stress_solid"]["von_mises"]
        print(
            f"| {name} | {solves(certificate)} | {error['mean_mm']:.4f} | {error['max_mm']:.3f} | "
            f"{stress['relative_l2']:.1e} | {seconds:.0f} |"
        )
    (own, seconds), (_, other) = kinds.values()
    print(f"solves={solves(own)} mean_mm={own['displacement']['mean_mm']:.4f} time_ratio={seconds / other:.3f}")


def solves(certificate: dict[str, Any]) -> int:
    """Numbers of training and held-out solutions together."""
    return certificate["samples"]["training"] + certificate["samples"]["held_out"]


if __name__ == "__main__":
    main()
