"""Errors that all values of a measurement have in common, so that no scatter shows them: of the model, and of a run.

A certificate has which changes of the parameters move the surface as the errors of the model's mesh and of its
reduction do. They are predicted as errors of points, and least squares turn them into errors of what is identified:
points see a modulus otherwise where a stroke is known than where it is not. Parameters that are not identified make
nothing good. Errors of all states belong together.

A run knows the state of each frame with a covariance. Most of such errors come from what all frames share, the
reference view and the landmarks in it. They count as one error of the whole sequence: the state of frame f is off by
C_f^1/2 z, with one z of all frames, and C_f^1/2 symmetric, so that neighbouring frames have nearly the same error.
Where their covariances commute, no other errors with these covariances differ less from frame to frame (Dowson and
Landau, 1982, https://doi.org/10.1016/0047-259X(82)90077-X). What is independent from frame to frame shows in the
residuals of the measurement, and counts with its scatter.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.run_folder import Run
from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.tracking.covariance import symmetric_root

Array = NDArray[np.float64]
Vector = Callable[[Mapping[str, float]], Array]
#: Step of a difference, of the parameters' ranges.
STEP = 1e-4


def shape_errors(
    model: ReducedModel, positions: Callable[[Vector], Array], vector: Vector, free: Collection[str]
) -> Array:
    """Errors (e, r, 3) of modelled points, m, independent of each other; as large as likely, of either sign.

    Parameters
    ----------
    model : whose errors they are; without any that are stated, e is 0.
    positions : where the model has the points (r, 3), m, if a function makes its parameters (d,) of the known ones.
    vector : such a function, with what is identified.
    free : names of the parameters that the fit may change; without any all count as such.
    """
    errors = ModelErrors.of(model)
    if errors is None:
        return np.zeros((0, *positions(vector).shape))
    if free:
        errors = errors.holding(np.array([k for k, p in enumerate(model.parameters) if p.name not in free], dtype=int))
    ranges = model.upper - model.lower
    changes: dict[bytes, Array] = {}

    def moved(share: float, k: int) -> Vector:
        def made(known: Mapping[str, float]) -> Array:
            mu = np.clip(vector(known), model.lower + STEP * ranges, model.upper - STEP * ranges)
            key = mu.tobytes()
            if key not in changes:
                changes[key] = symmetric_root(errors.at(mu, followed=False).parameters / np.outer(ranges, ranges))
            return mu + share * ranges * changes[key][:, k]

        return made

    positions(moved(0.0, 0))
    share = STEP / max(float(np.abs(list(changes.values())).max()), np.finfo(float).tiny)
    differences = [positions(moved(share, k)) - positions(moved(-share, k)) for k in range(len(ranges))]
    return np.array(differences) / (2.0 * share)


def state_errors(run: Run, rows: Sequence[int], vector: Vector, slopes: Callable[[Array], Array]) -> Array:
    """Errors (e, n) of what a model predicts in frames of a run, by those of the states that the run found there.

    They are independent of each other, as large as likely, of either sign, and each is one of all frames.

    Parameters
    ----------
    run : whose states they are; without covariances e is 0.
    rows : (n,) of the frames in the run.
    vector : makes the model's parameters (d,), SI, of those that the run found, by name; what is identified is none of
        them, so that it does not depend on what the run has of that.
    slopes : derivatives (d,) of what is predicted by the model's parameters (d,), SI.
    """
    if run.covariances is None:
        return np.zeros((0, len(rows)))
    parameters = run.model.parameters
    ranges = np.array([p.upper - p.lower for p in parameters])
    errors = np.zeros((len(parameters), len(rows)))
    for at, row in enumerate(rows):
        known = {p.name: float(value) for p, value in zip(parameters, run.parameters[row], strict=True)}
        mu = vector(known)
        away = [vector({**known, p.name: known[p.name] + STEP * r}) for p, r in zip(parameters, ranges, strict=True)]
        by_known = (np.array(away) - mu) @ slopes(mu) / STEP
        covariance = run.covariances[row, : len(ranges), : len(ranges)] / np.outer(ranges, ranges)
        errors[:, at] = symmetric_root(covariance) @ by_known
    return errors


def stacked(errors: Sequence[Array], sources: Sequence[Hashable]) -> Array:
    """Errors (e, n) of all tables together; those of tables of one source are the same ones.

    Parameters
    ----------
    errors : (e_j, n_j) of each table.
    sources : of each table.
    """
    blocks = [np.zeros((0, sum(part.shape[1] for part in errors)))]
    for source in dict.fromkeys(sources):
        parts = [part if own == source else part[:0] for part, own in zip(errors, sources, strict=True)]
        height = max(map(len, parts))
        blocks.append(np.hstack([np.pad(part, ((0, height - len(part)), (0, 0))) for part in parts]))
    return np.vstack(blocks)
