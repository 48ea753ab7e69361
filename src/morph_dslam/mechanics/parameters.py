"""A study's parameters as symbols, for use in materials, loads, supports and shapes alike.

    symbols = ParameterSymbols((angle, young))
    NeoHookean(young=symbols["young"], poisson=0.45)
    RigidRotation("top", axis=(0.0, 1.0, 0.0), angle=2.0 * symbols["angle"])

Any arithmetic on a symbol is an expression that NGSolve evaluates and differentiates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.model import Parameter
from morph_dslam.model.parameters import state_text

Array = NDArray[np.float64]
#: A number, or an expression of parameter symbols.
Scalar = Any


class ParameterSymbols:
    """The d parameters of a study with a present value each, at first the default.

    Parameters
    ----------
    parameters : of the study.
    clock : name of the one that is the time; empty if none is.
    amplitudes : functions of the time by their names. Their symbols follow the time, and expressions of them are not
        differentiated by it.
    """

    def __init__(
        self, parameters: Sequence[Parameter] = (), clock: str = "", amplitudes: Mapping[str, Amplitude] | None = None
    ) -> None:
        self.parameters, self.clock, self.amplitudes = tuple(parameters), clock, dict(amplitudes or {})
        self._symbols = {p.name: ngs.Parameter(p.default) for p in self.parameters}
        if len(self._symbols) < len(self.parameters):
            raise StudyError("two parameters have the same name; parameter names must differ")
        self._amplitudes = {name: ngs.Parameter(0.0) for name in self.amplitudes}
        self._follow_time()

    def __len__(self) -> int:
        return len(self.parameters)

    def __getitem__(self, name: str) -> ngs.Parameter:
        """The symbol of a parameter or an amplitude. Raises StudyError if there is none of this name."""
        if name in self._amplitudes:
            return self._amplitudes[name]
        if name not in self._symbols:
            known = ", ".join(self._symbols) or "none"
            raise StudyError(f"there is no parameter '{name}'; there are: {known}")
        return self._symbols[name]

    @property
    def default(self) -> Array:
        """Values (d,) of the state that nothing is known about, SI."""
        return np.array([p.default for p in self.parameters])

    @property
    def present(self) -> Array:
        """Values (d,) now, SI."""
        return np.array([symbol.Get() for symbol in self._symbols.values()])

    def text(self, mu: Array) -> str:
        """A state (d,), SI, for messages: "load = 0.015 N, modulus = 3 MPa"."""
        return state_text(self.parameters, mu)

    def set(self, mu: Array) -> None:
        """Make ``mu`` (d,), SI, the present values."""
        for symbol, value in zip(self._symbols.values(), np.atleast_1d(mu), strict=True):
            symbol.Set(float(value))
        self._follow_time()

    def _follow_time(self) -> None:
        """Give the amplitudes' symbols their values at the present time."""
        for name, amplitude in self.amplitudes.items():
            self._amplitudes[name].Set(float(amplitude(self._symbols[self.clock].Get())))

    def telling_states(self) -> list[Array]:
        """States (d,) in at least one of which two different expressions have different values.

        Drawn from the ranges, three or one at each end of a straight line of an amplitude: there amplitudes that differ
        differ.
        """
        low, high = (np.array([getattr(p, end) for p in self.parameters]) for end in ("lower", "upper"))
        times = [time for amplitude in self.amplitudes.values() for time in amplitude.times]
        states = np.random.default_rng(0).uniform(low, high, (3 + len(times), len(self)))
        if times:
            clock = [parameter.name for parameter in self.parameters].index(self.clock)
            states[3:, clock] = np.clip(times, low[clock], high[clock])
        return list(states)

    def value(self, expression: Scalar) -> float:
        """Value of an expression that does not vary in space, at the present parameters."""
        return evaluate(expression)

    def slopes(self, expression: Scalar) -> Array:
        """Derivatives (d,) of an expression that does not vary in space, at the present parameters."""
        result = np.zeros(len(self))
        for index, derivative in self.derivatives(expression).items():
            result[index] = evaluate(derivative)
        return result

    def values(self, vector: Sequence[Scalar]) -> Array:
        """Values (k,) of the entries of a vector, as `value`."""
        return np.array([self.value(entry) for entry in vector])

    def vector_slopes(self, vector: Sequence[Scalar]) -> Array:
        """Derivatives (d, k) of the entries of a vector, as `slopes`."""
        return np.column_stack([self.slopes(entry) for entry in vector])

    def derivatives(self, expression: Any) -> dict[int, Any]:
        """Derivatives of an expression, as expressions, by the index of each parameter it depends on."""
        if isinstance(expression, (int, float)):
            return {}
        slopes = {i: expression.Diff(symbol) for i, symbol in enumerate(self._symbols.values())}
        return {i: slope for i, slope in slopes.items() if not is_zero(slope)}


def is_zero(expression: Any) -> bool:
    """Whether NGSolve has found an expression to vanish identically."""
    # The text of an expression has shared parts once for each use, and may fill the memory; that of a compiled one not.
    steps = str(expression.Compile()).split("\n", 2)[1:]
    return steps[0].startswith(_zero_step()) and not steps[1].strip()


@cache
def _zero_step() -> str:
    """The only step of a compiled zero."""
    return str(ngs.CF(0.0).Compile()).splitlines()[1]
