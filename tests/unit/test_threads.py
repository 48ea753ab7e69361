"""Linear algebra in one thread, as the library that does it says itself."""

import numpy as np
from threadpoolctl import threadpool_info

from morph_dslam.threads import one_thread_for_algebra


def algebra_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@one_thread_for_algebra
def product(size):
    """The sum of a product of matrices of ones, and how many threads it may take."""
    return float((np.ones((size, size)) @ np.ones((size, size))).sum()), algebra_threads()


def test_linear_algebra_runs_in_one_thread_meanwhile_and_as_before_afterwards():
    before = algebra_threads()
    total, meanwhile = product(size=40)
    assert total == 40.0**3
    assert meanwhile
    assert set(meanwhile) == {1}
    assert algebra_threads() == before
