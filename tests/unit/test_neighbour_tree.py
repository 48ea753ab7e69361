"""The tree of a sweep: on grids every path leads outwards from the defaults, without detours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from morph_dslam.studies.sweep import neighbour_tree


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def path_to_root(sample: int, parent: list[int]) -> list[int]:
    path = [sample]
    while parent[path[-1]] >= 0:
        path.append(parent[path[-1]])
    return path


@pytest.mark.parametrize(
    ("axes", "root"),
    [
        ((np.linspace(0.0, 6e5, 7), np.linspace(2e6, 4e6, 7)), (0.0, 3e6)),
        ((np.linspace(-0.3, 0.3, 7), np.linspace(0.1, 0.7, 7)), (0.0, 0.4)),
        ((np.linspace(-1.0, 1.0, 5),) * 3, (0.0, 0.5, -1.0)),
        ((np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 3), np.linspace(-2.0, 2.0, 5)), (0.0, 0.5, 0.0)),
    ],
)
def test_paths_on_a_grid_lead_outwards(axes, root) -> None:
    """Along every path, no parameter ever comes nearer to its default again, and one changes at a time."""
    samples, scale = grid(*axes), np.array([np.ptp(axis) for axis in axes])
    order, parent = neighbour_tree(samples, scale, np.array(root))
    assert sorted(order) == list(range(len(samples)))
    away = np.abs(samples - root) / scale
    for sample in order:
        if parent[sample] >= 0:
            change = away[sample] - away[parent[sample]]
            assert np.count_nonzero(np.abs(change) > 1e-9) == 1
            assert change.min() > -1e-9
            steps = path_to_root(sample, parent)
            assert len(steps) == len(set(steps))


def test_scattered_samples_are_joined_by_a_shortest_tree() -> None:
    """Its length equals that of scipy's minimum spanning tree; all parents come before their children."""
    samples = np.random.default_rng(2).uniform(size=(150, 4)) * [1.0, 2.0, 3.0, 1e-3]
    scale, root = np.array([1.0, 2.0, 3.0, 1e-3]), np.zeros(4)
    order, parent = neighbour_tree(samples, scale, root)
    points = np.vstack([samples, root]) / scale
    length = sum(np.linalg.norm(points[s] - points[parent[s]]) for s in order)
    assert length == pytest.approx(minimum_spanning_tree(cdist(points, points)).sum(), rel=1e-12)
    rank = {sample: number for number, sample in enumerate(order)} | {-1: -1}
    assert all(rank[parent[sample]] < rank[sample] for sample in order)


def test_nothing_starts_from_failed_samples_and_solved_ones_are_not_ordered() -> None:
    samples = np.arange(1.0, 7.0)[:, None]
    order, parent = neighbour_tree(samples, np.ones(1), np.zeros(1), solved=[0, 1], failed=[2])
    assert order == [2, 3, 4, 5]
    assert [parent[s] for s in order] == [1, 1, 3, 4]
