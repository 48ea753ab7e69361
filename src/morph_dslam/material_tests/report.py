"""What a fit to material tests found: figures for programs, a section for a study, lines for people, a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.io.folders import check_free
from morph_dslam.io.writing import writing
from morph_dslam.material_tests.candidates import FittedLaw, kind_in_tension, recommended, untested_spread
from morph_dslam.material_tests.nominal_stress import KINDS, MaterialTest, NominalStress, largest_invariant
from morph_dslam.material_tests.stability import stretches_up_to
from morph_dslam.mechanics.materials.library import constant_quantities

Array = NDArray[np.float64]
DPI = 110
#: The file by which a fit is known.
RESULT = "fit.json"
#: Note a test that returns by more than this part of its strain while the law is elastic.
_RETURNS = 0.1
#: Note laws that differ by more than this where nothing was measured.
_WIDE = 0.1
_MEGAPASCAL = 1e6


def check_no_fit(folder: str | Path, overwrite: bool) -> None:
    """Raise IdentificationError if a folder holds a fit that is not to be overwritten."""
    check_free(Path(folder), (RESULT, "material.toml", "fit.png"), "a fit", overwrite, IdentificationError)


def write_fit(
    folder: str | Path, fitted: Sequence[FittedLaw], tests: Sequence[MaterialTest], name: str
) -> dict[str, Any]:
    """Write ``fit.json``, ``material.toml`` with the recommended law, and ``fit.png``; returns the figures.

    Parameters
    ----------
    folder : made if it is not there.
    fitted : the laws, at least one.
    tests : what they were fitted to.
    name : of the material in the study.

    Raises
    ------
    IdentificationError
        If a file cannot be written.
    """
    folder = Path(folder)
    figures = summarise(fitted, tests)
    with writing(IdentificationError, folder):
        folder.mkdir(parents=True, exist_ok=True)
        section = section_text(recommended(fitted, tests), tests, name)
        (folder / "material.toml").write_text(section, encoding="utf-8")
        _draw(folder / "fit.png", fitted, tests)
        # The last one: by it a fit is known.
        (folder / RESULT).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return figures


def summarise(fitted: Sequence[FittedLaw], tests: Sequence[MaterialTest]) -> dict[str, Any]:
    """The content of ``fit.json``, SI, plain JSON."""
    return {
        "tests": [_test_figures(test) for test in tests],
        "laws": [_law_figures(each) for each in fitted],
        "recommended": recommended(fitted, tests).name,
        "spread_where_not_tested": untested_spread(fitted, tests),
    }


def _test_figures(test: MaterialTest) -> dict[str, Any]:
    return {
        "name": test.name,
        "kind": test.kind,
        "points": len(test.stretch),
        "stretch": [float(np.min(test.stretch)), float(np.max(test.stretch))],
        "times": test.time is not None,
        "returns": _returned(test.stretch) > _RETURNS,
    }


def _returned(stretch: Array) -> float:
    """How far a test goes both up and down in tension, or in compression, over its largest strain.

    A table may begin with the most compressed row, or at any other end: only what goes both ways has gone back.
    """
    strain = stretch - 1.0
    back = [0.0]
    for side in (_one_side(strain), _one_side(-strain)):
        if len(side):
            up, down = side - np.minimum.accumulate(side), np.maximum.accumulate(side) - side
            back.append(min(float(up.max()), float(down.max())))
    return max(back) / float(np.abs(strain).max())


def _one_side(strain: Array) -> Array:
    """Those of strains (n,) that are above zero (m,), with one zero for each run of other rows before or between them.

    Rows at rest or on the other side that come last may be where another specimen begins.
    """
    side = np.trim_zeros(np.maximum(strain, 0.0), "b")
    return side[(side > 0.0) | np.diff(side > 0.0, prepend=True)]


def _law_figures(each: FittedLaw) -> dict[str, Any]:
    fit = each.fit
    return {
        "name": each.name,
        "section": each.section,
        "constants": [
            {
                "name": name,
                "value": value,
                "standard_deviation": fit.deviations[name] if np.isfinite(fit.deviations[name]) else None,
                "half_interval_95": fit.halves[name] if np.isfinite(fit.halves[name]) else None,
                "at_bound": bool(np.isnan(fit.deviations[name])),
            }
            for name, value in fit.constants.items()
        ],
        "shear_modulus": each.shear,
        "error": fit.error,
        "errors": list(fit.errors),
        "unstable_from_stretch": dict(each.unstable),
    }


def section_text(each: FittedLaw, tests: Sequence[MaterialTest], name: str) -> str:
    """A study's section [materials.NAME], with where it comes from as comments."""
    lines = [
        f"# {each.name}, fitted by `morph fit`: error {100.0 * each.fit.error:.2g} % of the root mean square stress of",
        *(f"# {t.name} ({t.kind}, stretch {t.stretch.min():.3g} to {t.stretch.max():.3g})" for t in tests),
        f"[materials.{name}]",
    ]
    quantities = constant_quantities(each.fit.material.law)
    for key, value in each.section.items():
        note = "  # chosen: such tests do not measure it" if key == "bulk" else ""
        lines.append(f"{key} = {_toml(value, quantities.get(key, ''))}{note}")
    return "\n".join(lines) + "\n"


def _toml(value: Any, quantity: str) -> str:
    if isinstance(value, Mapping):
        parts = [f"{key} = {_toml(v, 'time' if key == 'times' else '')}" for key, v in value.items()]
        return f"{{ {', '.join(parts)} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(each, quantity) for each in value)}]"
    if isinstance(value, str):
        return json.dumps(value)
    units = {"stress": (_MEGAPASCAL, "MPa"), "time": (1.0, "s")}
    if quantity in units:
        scale, unit = units[quantity]
        return f'"{value / scale:.6g} {unit}"'
    return f"{value:.6g}"


def fit_lines(figures: Mapping[str, Any]) -> list[str]:
    """The laws from the best to the worst, and what a reader must know of the recommended one."""
    laws = sorted(figures["laws"], key=lambda each: each["error"])
    said = [_law_line(each, each["name"] == figures["recommended"]) for each in laws]
    chosen = next(each for each in laws if each["name"] == figures["recommended"])
    for constant in chosen["constants"]:
        said.append(f"  {_constant_line(constant)}")
    if chosen["unstable_from_stretch"]:
        said.append(
            f"note: {chosen['name']} is unstable {_unstable(chosen)}, within the strains of the tests: solves may fail "
            "there; fit other laws, or fewer constants"
        )
    elastic = "prony" not in chosen["section"]
    if returning := [test["name"] for test in figures["tests"] if elastic and test["returns"]]:
        advice = "give its first loading alone, or a Prony series (--prony) to a test with times"
        said.append(f"note: {', '.join(returning)} unloads; an elastic law takes the mean of both ways: {advice}")
    if slow := [test["name"] for test in figures["tests"] if not (elastic or test["times"])]:
        said.append(
            f"note: {', '.join(slow)} {'has' if len(slow) == 1 else 'have'} no times: taken as so slow that all has "
            "relaxed; a column such as time_s tells how fast"
        )
    wide = {kind: spread for kind, spread in figures["spread_where_not_tested"].items() if spread > _WIDE}
    if wide:
        listed = ", ".join(f"{kind} tension: {100.0 * spread:.0f} %" for kind, spread in wide.items())
        said.append(
            f"note: laws that fit about as well differ where nothing was measured ({listed}); test that as well"
        )
    return said


def _law_line(each: Mapping[str, Any], chosen: bool) -> str:
    unstable = f", unstable {_unstable(each)}" if each["unstable_from_stretch"] else ""
    mark = "  <- material.toml" if chosen else ""
    n = len(each["constants"])
    return (
        f"{each['name']:14} error {100.0 * each['error']:6.2f} %, {n} constant{'s' * (n > 1)}, shear modulus "
        f"{each['shear_modulus'] / _MEGAPASCAL:.4g} MPa{unstable}{mark}"
    )


def _unstable(each: Mapping[str, Any]) -> str:
    return ", ".join(
        f"from a stretch of {stretch:.3g} in {kind} tension" for kind, stretch in each["unstable_from_stretch"].items()
    )


def _constant_line(constant: Mapping[str, Any]) -> str:
    name, value, half = constant["name"], constant["value"], constant["half_interval_95"]
    stress = not name.startswith(("exponent", "limit", "relative_modulus", "time"))
    scale, unit = (_MEGAPASCAL, " MPa") if stress else (1.0, " s" if name.startswith("time") else "")
    if constant["at_bound"]:
        return f"{name} = {value / scale:.4g}{unit}, at the end of its range"
    if half is None:
        return f"{name} = {value / scale:.4g}{unit}, without an interval: too few points, or tests that do not tell it"
    low, weak = value - half, "; these tests hardly determine it" if half > abs(value) else ""
    if name.startswith(("modulus", "limit", "relative_modulus", "time")):
        low = max(low, 0.0)
    low, high = low / scale, (value + half) / scale
    return f"{name} = {value / scale:.4g}{unit}, 95 % interval {low:.4g} to {high:.4g}{unit}{weak}"


def fit_last_line(figures: Mapping[str, Any]) -> str:
    """The recommended law in one line."""
    chosen = next(each for each in figures["laws"] if each["name"] == figures["recommended"])
    return (
        f"law={chosen['name']} shear_MPa={chosen['shear_modulus'] / _MEGAPASCAL:.5g} "
        f"error_percent={100.0 * chosen['error']:.2f}"
    )


def _draw(path: Path, fitted: Sequence[FittedLaw], tests: Sequence[MaterialTest]) -> None:
    """Measured points and computed curves, a panel for each kind of test; kinds that were not made show the spread.

    That of a bar that was pressed only shows what is predicted of its tension too.
    """
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    best = recommended(fitted, tests)
    most = largest_invariant(tests)
    at_once = "" if best.fit.material.prony is None else ", instantaneous"
    tested = {kind_in_tension(test) for test in tests}
    for place, kind in enumerate(KINDS, start=1):
        axes = figure.add_subplot(1, len(KINDS), place)
        made = [test for test in tests if test.kind == kind]
        in_time = best.fit.material.prony is not None and any(test.time is not None for test in made)
        if in_time:
            _draw_in_time(axes, best, tests, kind)
        else:
            _draw_over_stretch(axes, fitted, best, made, kind, None if made and kind in tested else most)
        pressed = "" if kind in tested else " compression" if in_time else " compression; tension not tested: predicted"
        state = "as the pressed bar" if kind in tested else "not tested"
        axes.set_title(f"{kind}{pressed}" if made else f"{kind} tension, {state}: predicted{at_once}", fontsize=10)
        axes.set_ylabel("nominal stress, MPa")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=DPI)


def _draw_over_stretch(
    axes: Axes,
    fitted: Sequence[FittedLaw],
    best: FittedLaw,
    made: Sequence[MaterialTest],
    kind: str,
    most: float | None,
) -> None:
    """Over the stretches that were measured, and in tension up to a first invariant of ``most`` where it is given."""
    ends = [*(test.stretch for test in made), *([] if most is None else [stretches_up_to(kind, most)])]
    low, high = min(1.0, *(e.min() for e in ends)), max(1.0, *(e.max() for e in ends))
    stretch = np.linspace(low, high, 200)
    for test in made:
        axes.plot(test.stretch, test.stress / _MEGAPASCAL, ".", color="0.3", label=test.name)
    shown = np.zeros(1)
    for each in fitted:
        # Where nothing was measured, what laws are compared by; slow tests have relaxed.
        law = each.fit.material if made else replace(each.fit.material, prony=None)
        curve = NominalStress(law, MaterialTest(kind, stretch, np.ones(len(stretch)), kind=kind))()
        width = 2.6 if each is best else 1.0
        axes.plot(stretch, curve / _MEGAPASCAL, lw=width, zorder=3 if each is best else 2, label=each.name)
        if each is best:
            shown = np.concatenate([curve, *(test.stress for test in made)]) / _MEGAPASCAL
    # Laws that fit badly may be far off where nothing was measured.
    low, high = min(0.0, shown.min()), max(0.0, shown.max())
    axes.set_ylim(1.3 * low - 0.03 * high, 1.3 * high - 0.03 * low)
    axes.set_xlabel("stretch")


def _draw_in_time(axes: Axes, best: FittedLaw, tests: Sequence[MaterialTest], kind: str) -> None:
    labels = ("measured", best.name)
    for test, computed in zip(tests, best.fit.computed, strict=True):
        if test.kind == kind and test.time is not None:
            axes.plot(test.time - test.time[0], test.stress / _MEGAPASCAL, ".", color="0.5", ms=4, label=labels[0])
            axes.plot(test.time - test.time[0], computed / _MEGAPASCAL, color="tab:red", lw=1.4, label=labels[1])
            labels = ("", "")
    axes.set_xlabel("time, s")
