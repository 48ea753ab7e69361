"""Solve the boot seal of the MORPH-DSLAM paper at full size and make its reduced model.

A bellows of revolution, 25 795 nodes and 18 403 linear hexahedra, neo-Hookean rubber: the floor holds its
bottom, a gear lever turns its top from 0 to 52 degrees, and 104 positions (or --positions) are solved on the
way. The model, its report and a picture are left in output/. An interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.reduction import read_reference_curve, report_path
from morph_dslam.extend.rendering import draw_states
from morph_dslam.extend.studies import Snapshot, SolidStudy, load_snapshot, snapshot_key

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
#: Mean errors that the paper's figure shows, by number of modes.
PAPER_ERRORS = HERE / "paper_errors.csv"
#: The lever's axis passes through this point of the object frame, metres, along y.
PIVOT = np.array([0.0, 0.0, 0.0417])
#: Of many positions so many measure the error: enough to bound it in 95 % of the range with 95 % confidence.
HELD_OUT = 59


def read_study(
    divisions: list[int] | None = None, cells: str | None = None, positions: int | None = None
) -> SolidStudy:
    """The study, if wished with a coarser mesh, other cells, or so many positions in all."""
    content = tomllib.loads((HERE / "study.toml").read_text())
    content["mesh"]["divisions"] = divisions or content["mesh"]["divisions"]
    content["mesh"]["cells"] = cells or content["mesh"]["cells"]
    if positions is not None:
        held_out = HELD_OUT if positions >= 4 * HELD_OUT else content["sampling"]["held_out"]
        content["sampling"] |= {"training": positions - held_out, "held_out": held_out}
    study = md.make_study(content, HERE, "study.toml")
    assert isinstance(study, SolidStudy)
    return study


def last_snapshot(study: SolidStudy, folder: Path) -> Snapshot:
    """The solution with the lever turned all the way."""
    upper = np.array([study.model_parameters()[0].upper])
    return load_snapshot(folder / f"{snapshot_key(study, upper)}.npz")


def moment_about_pivot(snapshot: Snapshot) -> float:
    """Moment that turns the lever, N mm."""
    about_origin, force = snapshot.outputs["moment_top"], snapshot.outputs["force_top"]
    return 1e3 * float((about_origin - np.cross(PIVOT, force))[1])


def draw(model: md.ReducedModel, path: Path) -> None:
    """The seal at rest, half way and at the end."""
    angles = np.linspace(model.lower[0], model.upper[0], 3)
    captions = [f"lever at {np.degrees(angle):.0f} deg" for angle in angles]
    picture = draw_states(model, [np.array([a]) for a in angles], captions, np.array([0.25, 1.0, -0.35]))
    cv2.imwrite(str(path), picture)


def run(arguments: argparse.Namespace) -> None:
    study = read_study(arguments.divisions, arguments.cells, arguments.positions)
    arguments.output.mkdir(parents=True, exist_ok=True)
    target = arguments.output / "boot_seal.morph"
    start = time.perf_counter()
    model = md.build(study, target)
    seconds = time.perf_counter() - start
    draw(model, arguments.output / "boot_seal.png")
    md.write_build_report(report_path(target), model, read_reference_curve(PAPER_ERRORS))
    end = last_snapshot(study, target.with_name(target.name + ".snapshots"))
    largest = 1e3 * float(np.linalg.norm(end.fields["displacement"], axis=1).max())
    errors, samples = model.certificate["displacement"], model.certificate["samples"]
    print(f"model    {target}, mean error {errors['mean_mm']:.2g} mm on unseen positions")
    print(f"picture  {arguments.output / 'boot_seal.png'}")
    print(f"report   {report_path(target)}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(
        f"snapshots={samples['training'] + samples['held_out']} seconds={seconds:.1f} "
        f"largest_mm={largest:.10g} moment_Nmm={moment_about_pivot(end):.10g} peak_memory_MB={peak:.0f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--divisions", type=int, nargs=3, metavar="N", help="cells along, through and around the wall")
    parser.add_argument("--cells", choices=("hex8", "hex20", "hex27"), help="type of cell")
    parser.add_argument("--positions", type=int, help="solved in all (default: those of the study, 104)")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder to write (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "the positions solved so far are kept")


if __name__ == "__main__":
    sys.exit(main())
