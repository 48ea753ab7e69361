"""Where a study is solved: samples of the parameter box, every scheme of them deterministic.

Scrambled Sobol samples are nested: the first of a longer sequence are the shorter one, so a study that asks
for more samples keeps those it has (Sobol 1967; scrambling after Owen 1998). So are the held-out samples,
which are drawn independently.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from morph_dslam.errors import StudyError
from morph_dslam.studies.body_study import BodyStudy
from morph_dslam.studies.problem import ParametricStudy, bounds
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.time_sampling import time_instants

Array = NDArray[np.float64]
#: How far training samples are moved from uniform to the Chebyshev density (`sample_box`).
TRAINING_TOWARDS_EDGES = 0.5
#: More points than these on a full grid are taken for a mistake: other schemes need far fewer.
MOST_GRID_POINTS = 100_000


def training_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that the model is made from; with "adaptive", those that are solved first."""
    sampling = study.sampling
    if sampling.scheme == "even":
        return even_samples(study, sampling.training)
    if sampling.scheme == "paths":
        return path_samples(study)
    if sampling.scheme == "grid":
        axes = grid_axes(study)  # the last parameter runs fastest
        return study.admissible(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)))
    if sampling.scheme == "adaptive" or not isinstance(study, BodyStudy):
        count = sampling.first if sampling.scheme == "adaptive" else sampling.training
        return sample_box(study, count, sampling.seed, TRAINING_TOWARDS_EDGES)
    # Scattered samples alone leave the corners of the box to extrapolation, and mostly the body is unloaded in one.
    scattered = sample_box(study, sampling.training - 1, sampling.seed, TRAINING_TOWARDS_EDGES)
    return np.vstack([study.root(), scattered])


def candidate_samples(study: ParametricStudy, count: int) -> Array:
    """Samples (count, d) among which adaptive sampling chooses: those that follow the training samples.

    A longer list begins with the shorter one, and no candidate is a training or a held-out sample.
    """
    sampling = study.sampling
    following = sample_box(study, sampling.first + count, sampling.seed, TRAINING_TOWARDS_EDGES)
    return following[sampling.first :]


def held_out_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that only measure the error: independent and uniform, as its statement assumes."""
    box, sampling = bounds(study), study.sampling
    unit = np.random.default_rng(sampling.seed + 1).random((sampling.held_out, len(box)))
    return study.admissible(box[:, 0] + unit * np.diff(box, axis=1).ravel())


def sample_box(study: ParametricStudy, count: int, seed: int, towards_edges: float) -> Array:
    """Scrambled Sobol samples (count, d) of the box; of two counts, the smaller gives the first samples.

    ``towards_edges`` in [0, 1] moves them from uniform to the Chebyshev density, at which polynomial
    regression is best conditioned.
    """
    box = bounds(study)
    sobol = qmc.Sobol(len(box), rng=seed)
    unit = 2.0 * sobol.random_base2(int(np.ceil(np.log2(count))))[:count] - 1.0
    xi = (1.0 - towards_edges) * unit + towards_edges * np.sin(np.pi / 2.0 * unit)
    return study.admissible(box.mean(axis=1) + xi * np.diff(box, axis=1).ravel() / 2.0)


def even_samples(study: ParametricStudy, count: int) -> Array:
    """Evenly spaced samples (count, 1), both ends included."""
    box = bounds(study)
    if len(box) != 1:
        raise StudyError(
            f'sampling.scheme = "even" is for one parameter, and this study has {len(box)}: use "grid" or "sobol"'
        )
    return study.admissible(np.linspace(box[0, 0], box[0, 1], count)[:, None])


def first_samples(study: ParametricStudy) -> Array:
    """Samples (n, 1) of a single parameter, both ends included, that bisection starts with."""
    if isinstance(study, SolidStudy) and study.time is not None:
        return study.admissible(time_instants(study)[:, None])
    return even_samples(study, study.sampling.first)


def path_samples(study: ParametricStudy) -> Array:
    """The same instants of time (n_paths * n_instants, d) for the defaults, and for scattered other parameters.

    One path in time has a solution at each of its instants, whatever their number.
    """
    if not isinstance(study, SolidStudy) or study.time is None:
        raise StudyError('sampling.scheme = "paths" is for studies with [time]: use "adaptive" or "sobol"')
    clock, instants = list(study.parameters).index(study.time.parameter), time_instants(study)
    scattered = sample_box(study, study.sampling.training - 1, study.sampling.seed, TRAINING_TOWARDS_EDGES)
    starts = np.vstack([study.root(), scattered])
    samples = np.repeat(starts, len(instants), axis=0)
    samples[:, clock] = np.tile(instants, len(starts))
    return study.admissible(samples)


def grid_axes(study: ParametricStudy) -> list[Array]:
    """Values of each parameter on the full grid, both ends included."""
    box, points = bounds(study), study.sampling.points
    counts = (points,) * len(box) if isinstance(points, int) else tuple(points or ())
    if len(counts) != len(box):
        names = ", ".join(parameter.name for parameter in study.model_parameters())
        raise StudyError(
            f"sampling.points has {len(counts)} numbers, and this study has {len(box)} parameters "
            f"({names}): give one number of points for each, in this order"
        )
    total = int(np.prod([float(count) for count in counts]))
    if total > MOST_GRID_POINTS:
        raise StudyError(
            f"the full grid of sampling.points has {total} points, more than {MOST_GRID_POINTS}: "
            'take fewer, or scheme = "sobol"'
        )
    return [np.linspace(low, high, count) for (low, high), count in zip(box, counts, strict=True)]
