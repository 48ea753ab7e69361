"""Half of a real sheet of paper painted over: what physics says of the half that no frame shows.

The recording is that of examples/kinect_paper, with measured points. From its second frame on, one half of the sheet is
painted grey, the left, right, lower and upper one in turn. The same tracker follows the other half with the example's
model of the sheet, and with bicubic displacements of the flat sheet without any mechanics, both with and without a
discrepancy. The errors are those of the measured points on the hidden half.
Which pixels are painted comes from a run over the whole pictures; nothing else does.

`measured points` is what the model itself can know: its parameters and pose are fitted to the measured points of the
seen half, in place of images, and those of the hidden half are compared.
Run: python benchmarks/hidden_half.py --data FOLDER
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path.insert(0, str(EXAMPLES))

import morph_dslam as md  # noqa: E402
from morph_dslam.extend.models import ParameterFunctions, SeparatedField  # noqa: E402
from morph_dslam.extend.registration import load_landmarks  # noqa: E402
from morph_dslam.extend.reports import load_truth, material_error  # noqa: E402
from morph_dslam.extend.tracking import View, draw_view  # noqa: E402
from support import data_folder, keep_model  # noqa: E402

KINECT = EXAMPLES / "kinect_paper"
FIRST, LAST = 9, 100
#: Halves by the coordinate of the flat sheet that is negative or positive there.
HALVES = {"left": (0, -1.0), "right": (0, 1.0), "lower": (1, -1.0), "upper": (1, 1.0)}
#: Errors of the hidden half, mm, with discrepancy and outline.
BEFORE = {"left": 17.6, "right": 27.1, "lower": 7.8, "upper": 7.1}
#: Painted beyond the half's edge on all sides, pixels, and the grey.
BEYOND, GREY = 9, 128
#: The models by name: whether they are bicubic, and have a discrepancy.
METHODS = {
    "physics": (False, False),
    "physics_discrepancy": (False, True),
    "polynomial": (True, False),
    "polynomial_discrepancy": (True, True),
}


def polynomial_sheet(model: md.ReducedModel, reference: np.ndarray) -> md.ReducedModel:
    """The sheet with bicubic displacements in place of mechanics: 48 parameters, metres, about a shape (n, 3)."""
    scaled = model.nodes[:, :2] / np.abs(model.nodes[:, :2]).max(axis=0)
    powers = [(i, j) for i in range(4) for j in range(4)]
    shapes = np.array([scaled[:, 0] ** i * scaled[:, 1] ** j for i, j in powers])
    modes = np.einsum("kn,ca->kcna", shapes, np.eye(3)).reshape(-1, len(scaled), 3)
    size, names = float(np.ptp(model.nodes[:, 0])), [f"{axis}{i}{j}" for i, j in powers for axis in "xyz"]
    count = len(names)
    parameters = tuple(md.Parameter(name, "length", "mm", -size, size, 0.0) for name in names)
    indices = np.vstack([np.zeros((1, count), dtype=np.int64), np.eye(count, dtype=np.int64)])
    coefficients = np.diag([1.0, *[size] * count])
    functions = ParameterFunctions(np.full(count, -size), np.full(count, size), indices, coefficients)
    displacement = SeparatedField(np.concatenate([reference[None], modes]), functions)
    return md.ReducedModel("bicubic sheet", model.nodes, model.triangles, parameters, displacement)


def tracked(data: Path, frames: Path, model: Path, method: tuple[bool, bool], folder: Path) -> None:
    """Track the pictures of a folder; the results are kept in ``folder``."""
    bicubic, discrepancy = method
    own = [data / name if (data / name).is_file() else KINECT / name for name in ("camera.yaml", "landmarks.csv")]
    md.track(
        md.TrackOptions(
            frames=frames,
            model=model,
            camera=own[0],
            landmarks=own[1],
            output=folder,
            first=FIRST,
            last=LAST,
            reference_frame=FIRST,
            refine_reference=not bicubic,
            at_rest=bicubic,
            video=False,
            overwrite=True,
            tracker=md.TrackerOptions(use_outline=True, use_discrepancy=discrepancy),
        )
    )


def paint(data: Path, whole: Path, half: str, folder: Path) -> None:
    """Copy the pictures with one half painted where the run over the whole ones has it."""
    run, (axis, sign) = md.load_run(whole), HALVES[half]
    inside = (sign * run.model.nodes[run.model.triangles][:, :, axis] >= 0.0).all(axis=1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BEYOND + 1,) * 2)
    covered = np.zeros((run.camera.height, run.camera.width), dtype=np.uint8)
    for row, frame in enumerate(run.frames.tolist()):
        picture = np.asarray(cv2.imread(str(next((data / "rgb").glob(f"{frame:03d}.*")))))
        if run.tracked[row]:
            nodes = run.camera_points(row)
            view = View(nodes, run.camera.project(nodes))
            drawn = draw_view(view, run.model.triangles[inside], run.camera).covered
            covered = cv2.dilate(drawn.astype(np.uint8), disc)
        if row:
            picture[covered > 0] = GREY
        cv2.imwrite(str(folder / f"{frame:03d}.png"), picture)


def on_half(flat: np.ndarray, half: str) -> np.ndarray:
    """Which points of the flat sheet (p, 3) are on a half."""
    axis, sign = HALVES[half]
    return sign * flat[:, axis] > 0.0


def hidden_error(data: Path, run_folder: Path, half: str) -> tuple[float, int]:
    """Mean error, mm, of the measured points on the hidden half, and frames that were not tracked."""
    run, truth = md.load_run(run_folder), load_truth(data / "ground_truth.npz")
    error = material_error(run, truth, int(truth.frames[truth.frames >= FIRST].min()))
    hidden = on_half(run.model.rest_positions(error.binding.points), half)
    return 1e3 * float(np.nanmean(error.distances[:, hidden])), int((~run.tracked).sum())


def fitted_error(data: Path, whole: Path, half: str) -> float:
    """Mean error, mm, of the hidden half where the model is fitted to the measured points of the other one."""
    run, truth = md.load_run(whole), load_truth(data / "ground_truth.npz")
    model, binding = run.model, material_error(run, truth, int(truth.frames[truth.frames >= FIRST].min())).binding
    rest, displacement = model.rest_positions(binding.points), model.restrict(binding.points)
    hidden = on_half(rest, half)
    size, errors = model.upper - model.lower, []

    def placed(unknowns: np.ndarray) -> np.ndarray:
        on_sheet = rest + displacement.value(np.clip(model.lower + unknowns[6:] * size, model.lower, model.upper))
        return Rotation.from_rotvec(unknowns[:3]).apply(on_sheet) + unknowns[3:6]

    x_scale = np.r_[np.full(3, 0.1), np.full(3, 0.05), np.full(len(size), 0.1)]
    bounds = np.r_[np.full(6, -np.inf), np.zeros(len(size))], np.r_[np.full(6, np.inf), np.ones(len(size))]
    for frame in truth.frames[truth.frames >= FIRST].tolist():
        measured = truth.points[truth.frames == frame][0][binding.columns]
        row = run.frames.tolist().index(frame)
        pose, shares = run.camera_from_object[row], (run.parameters[row] - model.lower) / size
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        start = np.r_[turn, pose[:3, 3], shares.clip(1e-3, 1.0 - 1e-3)]

        def miss(unknowns: np.ndarray, measured: np.ndarray = measured) -> np.ndarray:
            return 1e3 * (placed(unknowns) - measured)[~hidden].ravel()

        found = least_squares(miss, start, bounds=bounds, x_scale=x_scale)
        errors.append(1e3 * np.linalg.norm(placed(found.x) - measured, axis=1)[hidden])
    return float(np.nanmean(errors))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder("kinect_paper"), help="the recording (%(default)s)")
    parser.add_argument("--halves", nargs="+", choices=HALVES, default=list(HALVES), help="which ones (all)")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="which ones (all)")
    parser.add_argument("--keep", type=Path, help="folder to keep pictures and runs in")
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        compare(arguments.data, arguments.halves, arguments.methods, arguments.keep or Path(temporary))


def compare(data: Path, halves: list[str], methods: list[str], folder: Path) -> None:
    """Print the table and the last line."""
    folder.mkdir(exist_ok=True, parents=True)
    physics, bicubic = KINECT / "output" / "sheet.morph", folder / "bicubic.morph"
    keep_model(KINECT / "study.toml", physics)
    model = md.load_model(physics)
    own = [data / name if (data / name).is_file() else KINECT / name for name in ("camera.yaml", "landmarks.csv")]
    start = md.register_landmarks(model, md.load_camera(own[0]), load_landmarks(own[1]))
    md.save_model(bicubic, polynomial_sheet(model, model.displacement.value(start.state.parameters)))
    tracked(data, data / "rgb", physics, METHODS["physics_discrepancy"], folder / "whole")
    found: dict[str, dict[str, float]] = {method: {} for method in methods}
    for half in halves:
        pictures = folder / half
        pictures.mkdir(exist_ok=True)
        paint(data, folder / "whole", half, pictures)
        print(
            f"{half:6s} {'measured points':24s} mean {fitted_error(data, folder / 'whole', half):6.2f} mm", flush=True
        )
        for method in methods:
            run = folder / f"{half}_{method}"
            tracked(data, pictures, bicubic if METHODS[method][0] else physics, METHODS[method], run)
            found[method][half], lost = hidden_error(data, run, half)
            print(f"{half:6s} {method:24s} mean {found[method][half]:6.2f} mm, {lost} frames lost", flush=True)
    if "physics" in methods and "polynomial" in methods:
        own, other = found["physics"], found["polynomial"]
        print(
            f"physics_mm={np.mean(list(own.values())):.2f} polynomial_mm={np.mean(list(other.values())):.2f} "
            f"ratio_to_polynomial={max(own[half] / other[half] for half in halves):.2f} "
            f"worst_of_today={max(own[half] / BEFORE[half] for half in halves):.2f}"
        )


if __name__ == "__main__":
    main()
