"""Fit a visco-hyperelastic law to half of the tension tests on a soft elastomer and predict the other half.

The measurements (VHB 4910: relaxation at eight stretches, loading and unloading to four stretches at three
rates) are not part of the project: a folder with `single-step-relaxation/time_strain_stress/*.xlsx` and
`uniaxial-loading-unloading/time_strain_stress/*.xlsx`, columns time (s), stretch, nominal stress (kPa).

The law is Ogden's with two terms and three Prony terms. Every second stretch is fitted (relaxation at 1.5,
2.5, 3.5 and 5; loops to 1.5 and 2.5 at each rate); the stretches between them and beyond are predicted.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib
import numpy as np

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.material_tests import Fit, MaterialTest, NominalStress, fit_law, relative_error
from morph_dslam.extend.mechanics import Material, Ogden
from support import data_folder

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
RELAXATION, LOOPS = "single-step-relaxation", "uniaxial-loading-unloading"
FITTED = {RELAXATION: ("1d5", "2d5", "3d5", "5d0"), LOOPS: ("1d5", "2d5")}
#: Points kept of each test: a relaxation's fast beginning and its slow end, or an even choice of a loop.
POINTS = 120
KILOPASCAL = 1e3


def read_sheet(path: Path) -> np.ndarray:
    """Numbers (n, columns) of a spreadsheet's first sheet, below its line of headings."""
    try:
        with zipfile.ZipFile(path) as book:
            text = book.read("xl/worksheets/sheet1.xml").decode()
        rows = [re.findall(r"<v>([^<]*)</v>", row) for row in re.findall(r"<row.*?</row>", text, re.S)]
        return np.array(rows[1:], dtype=float).reshape(-1, 3)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise md.MorphError(f"{path} is no sheet of time, stretch and stress: {error}") from error


def read_test(path: Path, kind: str) -> MaterialTest:
    """One measurement, thinned, in SI; it begins at rest and undeformed."""
    time, stretch, stress = read_sheet(path).T
    last = len(time) - 1
    if kind == RELAXATION:
        end_of_ramp = int(np.argmax(stretch))
        spread = end_of_ramp + np.geomspace(1, last - end_of_ramp, POINTS - end_of_ramp)
        chosen = np.unique(np.r_[np.arange(end_of_ramp + 1), spread.astype(int)])
    else:
        chosen = np.unique(np.linspace(0, last, min(last + 1, POINTS)).astype(int))
    label = path.stem.replace("d", ".").replace("_", "/s to ")
    name = f"{'relaxation' if kind == RELAXATION else 'loop'} {label}"
    # The first reading of a loop is taken at a small stretch already.
    start = time[0] - 1e-3
    return MaterialTest(
        name, np.r_[1.0, stretch[chosen]], np.r_[0.0, stress[chosen] * KILOPASCAL], np.r_[start, time[chosen]]
    )


def read_tests(folder: Path) -> tuple[list[MaterialTest], list[MaterialTest]]:
    """The tests to fit, and those to predict."""
    fitted, predicted = [], []
    for kind, stretches in FITTED.items():
        paths = sorted((folder / kind / "time_strain_stress").glob("*.xlsx"))
        if not paths:
            raise md.MorphError(
                f"there are no measurements in {folder / kind / 'time_strain_stress'}; "
                "--data names the folder of VHB 4910"
            )
        for path in paths:
            (fitted if path.stem[-3:] in stretches else predicted).append(read_test(path, kind))
    return fitted, predicted


def two_term_ogden(modulus_1: float, exponent_1: float, modulus_2: float, exponent_2: float) -> Ogden:
    """The law of this example; the bulk modulus does not matter in incompressible tension."""
    return Ogden(moduli=(modulus_1, modulus_2), exponents=(exponent_1, exponent_2), bulk=1e8)


def fit(tests: list[MaterialTest]) -> Fit:
    bounds = {"modulus_1": (1e3, 1e6), "exponent_1": (0.2, 2.0), "modulus_2": (1e2, 1e5), "exponent_2": (2.0, 6.0)}
    shares, times = [(0.01, 0.99)] * 3, [(0.1, 5.0), (5.0, 50.0), (50.0, 1000.0)]
    return fit_law(two_term_ogden, bounds, tests, (shares, times), starts=2)


def evaluate_tests(material: Material, tests: list[MaterialTest]) -> list[np.ndarray]:
    """Nominal stress (n,), Pa, of a material in each test."""
    return [NominalStress(material, test)() for test in tests]


def overall_error(tests: list[MaterialTest], computed: list[np.ndarray]) -> float:
    """Root mean square difference of all tests over their root mean square stress, percent."""
    return 100.0 * relative_error(np.concatenate([t.stress for t in tests]), np.concatenate(computed))


def draw(parts: dict[str, tuple[list[MaterialTest], list[np.ndarray]]], path: Path) -> None:
    """Measured points and computed lines: relaxation over time, loops over stretch for each rate."""
    figure, axes = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    rates = ["0.01/s", "0.03/s", "0.05/s"]
    panels = dict(zip(["relaxation", *rates], axes.ravel(), strict=True))
    for part, (tests, stresses) in parts.items():
        for test, computed in zip(tests, stresses, strict=True):
            relaxing = test.name.startswith("relaxation")
            axis = panels["relaxation" if relaxing else test.name.split()[1]]
            x = test.time if relaxing and test.time is not None else test.stretch
            colour = "tab:blue" if part == "fitted" else "tab:red"
            axis.plot(x[1:], test.stress[1:] / KILOPASCAL, ".", color="0.45", markersize=4)
            axis.plot(x[1:], computed[1:] / KILOPASCAL, color=colour, lw=1.4)
            if relaxing:
                end = (x[-1], test.stress[-1] / KILOPASCAL)
                axis.annotate(test.name.split()[-1], end, (5, -3), textcoords="offset points", fontsize=8)
    for name, axis in panels.items():
        relaxing = name == "relaxation"
        axis.set_title("relaxation at the stretches written" if relaxing else f"loading and unloading, {name}")
        axis.set_xlabel("time, s" if relaxing else "stretch")
        axis.set_ylabel("nominal stress, kPa")
    axes[0, 0].set_xscale("log")
    axes[0, 0].set_xlim(0.45, 700.0)
    handles = [
        Line2D([], [], color="0.45", ls="", marker=".", label="measured"),
        Line2D([], [], color="tab:blue", label="fitted"),
        Line2D([], [], color="tab:red", label="predicted"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(arguments: argparse.Namespace) -> None:
    fitted, predicted = read_tests(arguments.data)
    print(f"fitting {len(fitted)} tests, to predict {len(predicted)}")
    result = fit(fitted)
    stresses = {"fitted": evaluate_tests(result.material, fitted)}
    stresses["predicted"] = evaluate_tests(result.material, predicted)
    for part, tests in (("fitted", fitted), ("predicted", predicted)):
        for test, computed in zip(tests, stresses[part], strict=True):
            print(f"{part:9}  {test.name:18} {100 * relative_error(test.stress, computed):5.1f} %")
    OUTPUT.mkdir(parents=True, exist_ok=True)
    (OUTPUT / "constants.json").write_text(json.dumps(result.constants, indent=2) + "\n")
    draw({"fitted": (fitted, stresses["fitted"]), "predicted": (predicted, stresses["predicted"])}, OUTPUT / "fit.png")
    print(f"constants and plot are in {OUTPUT}")
    errors = {
        part: overall_error(tests, stresses[part]) for part, tests in (("fitted", fitted), ("predicted", predicted))
    }
    print(f"fit_error_percent={errors['fitted']:.2f} predicted_error_percent={errors['predicted']:.2f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=data_folder("fem_reference/vhb4910"), help="folder of the tests (%(default)s)"
    )
    return run_and_report_errors(run, parser.parse_args(), "nothing was written")


if __name__ == "__main__":
    sys.exit(main())
