"""The estimator against its alternatives on the same problem, in the same run.

    python benchmarks/estimator.py

500 points, 16 modes of 4 parameters with 330 Chebyshev terms, and the pose. Times are medians; every method
starts from the same state and its cost at the end is shown, so that a fast wrong answer is seen.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from scipy.optimize import least_squares

from morph_dslam import Camera, Parameter, ReducedModel
from morph_dslam.extend.geometry import RigidTransform, cross_matrix, rotation_exp
from morph_dslam.extend.models import ParameterFunctions, SeparatedField, SurfacePoints, total_degree_indices
from morph_dslam.extend.tracking import BoundPoints, Estimator, State, moved
from morph_dslam.tracking.reprojection import project_with_jacobian

N_POINTS, N_MODES, DEGREE = 500, 16, 7
CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)


def smooth_model() -> ReducedModel:
    """A sheet of 2 600 nodes with smooth modes whose size falls with the degree, as a POD's does."""
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 65), np.linspace(-1, 1, 40)))
    nodes = np.column_stack([0.21 * x, 0.1485 * y, np.zeros(x.size)])
    index = np.arange(x.size).reshape(40, 65)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    waves = [np.cos(k * x + m * y + k) for k in range(1, 5) for m in range(4)]
    modes = np.stack([np.column_stack([0.1 * w, 0.1 * w, w]) for w in waves])
    multi_indices = total_degree_indices(4, DEGREE)
    size = 0.02 * np.exp(-1.0 * multi_indices.sum(axis=1))[:, None]
    coefficients = size * rng.standard_normal((len(multi_indices), N_MODES))
    functions = ParameterFunctions(-np.ones(4), np.ones(4), multi_indices, coefficients)
    parameters = tuple(Parameter(name, "ratio", "1", -1.0, 1.0, 0.0) for name in "abcd")
    return ReducedModel("benchmark", nodes, triangles, parameters, SeparatedField(modes, functions))


def left_jacobian(vector):
    """d exp(w) exp(-w0) / dw at w0 = ``vector`` (3,), the left Jacobian (3, 3) of the rotation group."""
    angle = max(float(np.linalg.norm(vector)), 1e-9)
    cross = cross_matrix(vector)
    squared = (angle - np.sin(angle)) / angle**3 * cross @ cross
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * cross + squared


def median_ms(function, repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = perf_counter()
        function()
        times.append(1e3 * (perf_counter() - start))
    return float(np.median(times))


def main() -> None:
    rng = np.random.default_rng(1)
    model = smooth_model()
    surface = SurfacePoints(rng.integers(0, len(model.triangles), N_POINTS), rng.dirichlet(np.ones(3), N_POINTS))
    points = BoundPoints.from_surface(model, surface)
    pose = RigidTransform(
        rotation_exp(np.array([0.2, -0.3, 0.1])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, 0.0, 0.6])
    )
    truth = State(np.array([0.3, 0.2, -0.4, 0.1]), pose)
    pixels = CAMERA.project(points.in_camera(truth)) + 0.5 * rng.standard_normal((N_POINTS, 2))
    weights = np.ones(N_POINTS)
    start = moved(truth, np.array([0.1, 0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.01, 0.01, 0.01]))
    estimator = Estimator(model, CAMERA)
    functions = points.field.functions

    def residuals(step):
        state = moved(start, step)
        return (CAMERA.project(points.in_camera(state)) - pixels).ravel()

    def jacobian(step):
        """With the left Jacobian of the rotation, because scipy's step is measured from the start."""
        state = moved(start, step)
        pose, rows = state.camera_from_object, functions.rows(state.parameters)
        result = project_with_jacobian(
            rows, pose.rotation, pose.translation, points.rest, points.field.modes, CAMERA.intrinsics
        )[1].reshape(-1, 10)
        result[:, 4:7] = result[:, 4:7] @ left_jacobian(step[4:7])
        return result

    scale = np.array([1.0, 1, 1, 1, 1, 1, 1, 0.5, 0.5, 0.5])

    def scipy_cost(jac):
        return least_squares(residuals, np.zeros(10), jac=jac, x_scale=scale, ftol=1e-6, method="lm").cost

    methods = {
        "Levenberg-Marquardt, analytic": (lambda: estimator.estimate(points, pixels, weights, start).cost, 200),
        "scipy least_squares, analytic": (lambda: scipy_cost(jacobian), 10),
        "scipy least_squares, differences": (lambda: scipy_cost("2-point"), 10),
    }
    base = None
    print(f"{N_POINTS} points, {N_MODES} modes, {len(functions.multi_indices)} terms, 4 parameters and pose")
    for name, (method, repeats) in methods.items():
        cost = method()
        time = median_ms(method, repeats)
        base = base or time
        print(f"{name:<34} {time:8.2f} ms  {time / base:6.1f} x  cost {cost:.3f}")


if __name__ == "__main__":
    main()
