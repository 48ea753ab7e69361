"""What a model itself adds to the deviations of a frame's estimate: by its mesh and by its reduction.

Both are made good by the parameters, since the images fix the shape. So they widen the deviations of the parameters,
and of the stresses and forces that follow from these. The displacement is off by what parameters cannot make good.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.parameter_errors import ParameterErrors
from morph_dslam.model.reduced_model import ReducedModel
from morph_dslam.model.reduction_errors import ReductionErrors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelDeviation:
    """What a model adds in one state.

    Attributes
    ----------
    by_mesh, by_reduction : (d, d) to the parameters' covariance, SI.
    displacement : to the displacement, root mean square length, metres.
    in_object : to the displacement in the object's frame, where what the pose makes good is an error too.
    """

    by_mesh: Array
    by_reduction: Array
    displacement: float
    in_object: float

    @property
    def parameters(self) -> Array:
        """To the parameters' covariance (d, d), SI."""
        return self.by_mesh + self.by_reduction


@dataclass(frozen=True)
class ModelErrors:
    """What a model adds in any state.

    Attributes
    ----------
    mesh : by its discretisation, if that was estimated.
    reduction : by its reduction, if that is known.
    constant : (d,) which parameters are found from all frames together.
    n_loads : unknown loads among the last parameters; the reduction adds nothing to them.
    clocks : numbers of the parameters that may be the time.
    others : as ``mesh``, by whether the pose is free.
    has_time : whether the time is known, so that it makes no error good.
    """

    mesh: ParameterErrors | None
    reduction: ReductionErrors | None
    constant: NDArray[np.bool_]
    n_loads: int
    clocks: tuple[int, ...] = ()
    others: dict[bool, ParameterErrors | None] = field(default_factory=dict)
    has_time: bool = False

    @classmethod
    def of(cls, model: ReducedModel, constant: Collection[str] = ()) -> ModelErrors | None:
        """Those of a model, of which parameters of these names are found from all frames together; None if unknown."""
        mesh, reduction = ParameterErrors.of(model), ReductionErrors.of(model.without_loads)
        if mesh is None and reduction is None:
            return None
        kept = np.array([parameter.name in constant for parameter in model.parameters], dtype=bool)
        products = None if mesh is None else mesh.products
        others = {False: mesh, True: ParameterErrors.of(model, True, products)}
        return cls(mesh, reduction, kept, model.n_loads, model.clocks, others)

    def where_known(self, known: NDArray[np.int64], free_pose: bool = False) -> ModelErrors:
        """The same where a clock may tell the time, and the pose is free, or not.

        Parameters
        ----------
        known : (k,) numbers of the parameters that clocks or sensors tell.
        free_pose : whether the images alone tell the pose.
        """
        has_time = len(self.clocks) == 1 and self.clocks[0] in known
        mesh = self.others[free_pose]
        if mesh is not None and has_time:
            mesh = mesh.holding(np.array(self.clocks))
        return replace(self, mesh=mesh, has_time=has_time)

    def holding(self, known: NDArray[np.int64], shares: Array | None = None) -> ModelErrors:
        """The same where something else tells parameters, and the others make the mesh's error good.

        ``known`` and ``shares`` are as of `ParameterErrors.holding`.
        """
        return self if self.mesh is None else replace(self, mesh=self.mesh.holding(known, shares))

    def at(self, mu: Array, followed: bool = True) -> ModelDeviation:
        """In the state ``mu`` (d,), SI; ``followed`` as in `ReductionErrors.covariance`."""
        by_mesh, by_reduction, squared, in_object = *np.zeros((2, len(mu), len(mu))), 0.0, 0.0
        if self.mesh is not None:
            by_mesh, left, with_pose = self.mesh.at(mu)
            squared, in_object = left**2, with_pose**2
        if self.reduction is not None:
            own, known = len(mu) - self.n_loads, np.zeros(len(mu), dtype=bool)
            known[list(self.clocks)] = self.has_time
            by_reduction[:own, :own] = self.reduction.covariance(mu[:own], self.constant[:own], known[:own], followed)
            size = self.reduction.size_at(mu[:own]) ** 2
            squared, in_object = squared + size, in_object + size
        return ModelDeviation(by_mesh, by_reduction, float(np.sqrt(squared)), float(np.sqrt(in_object)))

    def in_common(self, mu: Array) -> tuple[Array, float]:
        """What is alike in all states: errors (d, k) of the parameters, SI, and of the displacement, as of `at`."""
        factors = np.zeros((len(mu), 0)) if self.mesh is None else self.mesh.factors(mu)
        return factors, self.at(mu).displacement
