"""Stability of a sweep's solutions, and the bifurcations that it may have passed.

An equilibrium is stable under its prescribed supports where the tangent on the free degrees of freedom is
positive definite; Sylvester's law of inertia counts its negative eigenvalues from the factorisation. Where
the count differs between two neighbours of the sweep, a critical point lies between them: a limit point, or
a bifurcation from which a branch leaves that the sweep has not followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.model import Parameter

Array = NDArray[np.float64]


def stability_report(
    parameters: Sequence[Parameter], samples: Array, pivots: dict[int, int | None], parents: Sequence[int]
) -> dict[str, Any]:
    """What a certificate says of stability, in plain JSON types.

    Parameters
    ----------
    samples : (n, d), SI. pivots : of each solved sample, the negative pivots of its tangent; None if they
        are not known. parents : of every sample, the neighbour that the sweep tree joins it to, or -1.

    Returns
    -------
    dict
        "statement"; numbers of solutions "stable", "unstable", "unknown"; "unstable_samples", coordinates and
        negative pivots of each; "passed", the neighbours between which the count changes.
    """
    counts = {index: count for index, count in sorted(pivots.items()) if count is not None}
    unstable = [index for index, count in counts.items() if count > 0]
    passed = [
        (parents[index], index)
        for index, count in counts.items()
        if counts.get(parents[index], count) != count
    ]
    return {
        "statement": _statement(len(pivots), len(counts), len(unstable), len(passed)),
        "stable": len(counts) - len(unstable),
        "unstable": len(unstable),
        "unknown": len(pivots) - len(counts),
        "unstable_samples": [
            {"coordinates": samples[index].tolist(), "negative_pivots": counts[index]} for index in unstable
        ],
        "passed": [
            {
                "between": [describe_point(parameters, samples[index]) for index in pair],
                "coordinates": [samples[index].tolist() for index in pair],
                "negative_pivots": [counts[index] for index in pair],
            }
            for pair in passed
        ],
    }


def stability_warnings(certificate: dict[str, Any]) -> list[str]:
    """Lines for whoever builds a model; none where all solutions are known to be stable."""
    report = certificate.get("stability")
    if report is None or not report["unstable"] + report["unknown"] + len(report["passed"]):
        return []
    lines = [report["statement"]]
    for place in report["passed"][:3]:
        before, after = place["negative_pivots"]
        lines.append(
            f"negative pivots change from {before} to {after} between {' and '.join(place['between'])}"
        )
    return lines


def _statement(solved: int, known: int, unstable: int, passed: int) -> str:
    if not known:
        return "the solver cannot tell whether the solutions are stable"
    told = f"; of {solved - known} it is not known" if known < solved else ""
    if not unstable:
        return f"{known} solutions are stable{told}" if told else f"all {known} solutions are stable"
    places = f"in {passed} places" if passed > 1 else "in one place"
    branches = f"; bifurcations may have been passed {places}" if passed else ""
    return f"{unstable} of {solved} solutions are unstable{branches}{told}"
