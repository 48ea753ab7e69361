"""Quantities that depend on the parameters: linear expressions as study files write them.

"3 MPa" is a number, "pressure" the parameter of that name, "0.5 * pressure + 2 kPa" and "10 N * share" (of a
parameter without unit) are sums of both. A parameter over a quantity of its own kind is a ratio, as in
"5 kPa * held / 2 s". A term may end with an amplitude, which it is multiplied by as time runs: "stroke * ramp".
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.model import Parameter
from morph_dslam.model.parameters import state_text
from morph_dslam.units import FACTORS, quantity_of, to_si

Array = NDArray[np.float64]
#: No number of a study is meant where it is larger, in whatever unit: what follows from it could overflow.
LARGEST = 1e30
_USUAL_UNITS = {"length": "mm", "stress": "MPa", "pressure": "kPa", "angle": "deg"}
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_WORD = r"[A-Za-z_][\w./]*"
_TERM = re.compile(
    rf"(?:(?P<number>{_NUMBER})(?:\s+(?P<unit>{_WORD}))?(?:\s*\*\s*(?P<factor>{_WORD}))?|(?P<name>{_WORD}))"
    rf"(?:\s*/\s*(?P<divisor>{_NUMBER})\s+(?P<divisor_unit>{_WORD}))?"
    rf"(?:\s*\*\s*(?P<amplitude>{_WORD}))?"
)


@dataclass(frozen=True)
class Amplitudes:
    """Those that a study has.

    Attributes
    ----------
    clock : index of the parameter that is the time.
    functions : by name.
    """

    clock: int = -1
    functions: Mapping[str, Amplitude] = field(default_factory=dict)


#: Of a study that has none.
NO_AMPLITUDES = Amplitudes()


@dataclass(frozen=True)
class Product:
    """factor * parameter * amplitude(time).

    Attributes
    ----------
    factor : SI.
    index : of the parameter; None for a factor alone.
    name, amplitude : of the amplitude.
    clock : index of the time.
    """

    factor: float
    index: int | None
    name: str
    amplitude: Amplitude
    clock: int

    def __call__(self, mu: Array) -> float:
        parameter = 1.0 if self.index is None else float(mu[self.index])
        return self.factor * parameter * float(self.amplitude(mu[self.clock]))


@dataclass(frozen=True)
class Affine:
    """constant + slopes . mu, and products with amplitudes.

    Attributes
    ----------
    constant : SI.
    slopes : (d,) by the parameters, SI.
    products : that are added.
    """

    constant: float
    slopes: tuple[float, ...]
    products: tuple[Product, ...] = ()

    def __call__(self, mu: Array) -> float:
        return self.constant + float(np.dot(self.slopes, mu)) + sum(product(mu) for product in self.products)

    @property
    def used(self) -> set[int]:
        """Indices of the parameters that change it."""
        in_products = {k for product in self.products for k in (product.index, product.clock) if k is not None}
        return {int(k) for k in np.flatnonzero(self.slopes)} | in_products

    def extremes(self, ends: Array) -> tuple[float, float]:
        """The least and the largest value where each term has its own, with parameters between ``ends`` (d, 2)."""
        terms = [slope * end for slope, end in zip(self.slopes, ends, strict=True)]
        for product in self.products:
            parameter = np.ones(1) if product.index is None else ends[product.index]
            terms.append(product.factor * np.outer(parameter, product.amplitude.values).ravel())
        return (
            self.constant + sum(float(term.min()) for term in terms),
            self.constant + sum(float(term.max()) for term in terms),
        )

    @property
    def fixed(self) -> bool:
        """Whether no parameter changes it."""
        return not self.used

    def expression(self, parameters: Sequence[Any], amplitudes: Mapping[str, Any] | None = None) -> Any:
        """The same in other variables, `ngs.Parameter` say: a number if fixed, else a sum over them."""
        result: Any = self.constant
        for slope, parameter in zip(self.slopes, parameters, strict=True):
            if slope:
                result = result + slope * parameter
        for product in self.products:
            factor = product.factor * (amplitudes or {})[product.name]
            result = result + (factor if product.index is None else factor * parameters[product.index])
        return result


def read_affine(
    value: Any, quantity: str | None, parameters: Sequence[Parameter], amplitudes: Amplitudes = NO_AMPLITUDES
) -> Affine:
    """An expression of a study file.

    Parameters
    ----------
    value : a text; for ratios a number too.
    quantity : a key of `morph_dslam.units.FACTORS` that it must measure; None: whatever its first term does.
    parameters : that it may name.
    amplitudes : that its terms may be multiplied by.

    Raises
    ------
    StudyError
        If it cannot be read, names an unknown parameter, measures something else, or has a number that no
        study means.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise StudyError(f"{value!r} is not a number with a unit, nor an expression of parameters")
    if not isinstance(value, str):
        if quantity not in ("ratio", None):
            raise StudyError(f'write {value} with its unit, "{value} {usual_unit(quantity)}" for example')
        return Affine(possible(float(value), str(value)), (0.0,) * len(parameters))
    known = {parameter.name: index for index, parameter in enumerate(parameters)}
    quantity = quantity or _own_quantity(value, known, parameters)
    constant, slopes, products = 0.0, np.zeros(len(parameters)), list[Product]()
    for sign, term in _terms(value):
        named, amplitude = _amplitude(term, value, amplitudes)
        number, name = _read_term(named, value, quantity, known, parameters)
        index = None if name is None else known[name]
        if amplitude:
            products.append(Product(sign * number, index, amplitude, amplitudes.functions[amplitude], amplitudes.clock))
        elif index is None:
            constant += sign * number
        else:
            slopes[index] += sign * number
    return Affine(constant, tuple(slopes.tolist()), tuple(products))


#: Parameters whose ends are all combined at most.
_MOST_COMBINED = 8


@dataclass(frozen=True)
class Variables:
    """What the expressions of a study may name.

    Attributes
    ----------
    parameters : d of them, in the order of the file.
    amplitudes : of the study's time.
    """

    parameters: Sequence[Parameter]
    amplitudes: Amplitudes = NO_AMPLITUDES

    @property
    def defaults(self) -> Array:
        """Values (d,) of the parameters, SI."""
        return np.array([p.default for p in self.parameters])

    def read(self, value: Any, quantity: str | None) -> Affine:
        """See `read_affine`."""
        return read_affine(value, quantity, self.parameters, self.amplitudes)

    def reader(self, mu: Array | None = None) -> Callable[[Any, str | None], float]:
        """Reads values as numbers at ``mu`` (d,), at the defaults if None."""
        at = self.defaults if mu is None else mu
        return lambda value, quantity: self.read(value, quantity)(at)

    def range_ends(
        self, used: Sequence[int] | None = None, combined: bool = False
    ) -> Iterator[tuple[list[int], Array]]:
        """Both ends of the range of each parameter ``used`` (None: of all), the others at their defaults.

        With each state (d,) the numbers of the parameters at an end; after single ones all ends ``combined``.
        """
        used = list(range(len(self.parameters)) if used is None else used)
        groups = [[k] for k in used]
        if combined and 1 < len(used) <= _MOST_COMBINED:
            groups.append(used)
        for group in groups:
            for values in itertools.product(*((self.parameters[k].lower, self.parameters[k].upper) for k in group)):
                mu = self.defaults
                mu[group] = values
                yield group, mu

    def text(self, mu: Array, among: Sequence[int]) -> str:
        """A state (d,), of the parameters of these numbers alone, for messages."""
        return state_text([self.parameters[k] for k in among], mu[list(among)])


def _amplitude(term: re.Match, text: str, known: Amplitudes) -> tuple[Mapping[str, Any], str]:
    """The parts of a term without its amplitude, and the amplitude's name; empty if it has none."""
    parts, name = term.groupdict(), term["amplitude"]
    for key in ("factor", "name"):
        if name is None and parts[key] in known.functions:
            name, parts[key] = parts[key], None
    if name is None:
        return parts, ""
    if name not in known.functions:
        listed = f"the amplitudes are {', '.join(known.functions)}" if known.functions else "the study has none"
        raise StudyError(
            f"'{text}' multiplies by '{name}', which is no amplitude of [time]; {listed}. Sums are linear: a term is a "
            "number, or a number times a parameter"
        )
    return parts, name


def usual_unit(quantity: str) -> str:
    """A unit in which numbers of a study are mostly meant, for examples in messages."""
    return _USUAL_UNITS.get(quantity) or next(iter(FACTORS[quantity]))


def possible(number: float, text: str) -> float:
    """The number; raises StudyError, naming the text, if it is not finite or larger than `LARGEST`."""
    if not abs(number) <= LARGEST:
        raise StudyError(f"'{text}' cannot be meant: numbers are finite, and at most {LARGEST:g}")
    return number


def _own_quantity(text: str, known: Mapping[str, int], parameters: Sequence[Parameter]) -> str:
    """What the first term of an expression measures."""
    _, term = _terms(text)[0]
    if term["unit"] is not None:
        return quantity_of(term["unit"])
    name = term["factor"] or term["name"]
    return parameters[known[name]].quantity if name in known and term["divisor"] is None else "ratio"


def _terms(text: str) -> list[tuple[float, re.Match]]:
    """The terms of a sum with their signs."""
    result, position, rest = [], 0, text.strip()
    while position < len(rest):
        sign = re.compile(r"\s*([+-]?)\s*").match(rest, position)
        assert sign is not None
        term = _TERM.match(rest, sign.end())
        if term is None or (result and not sign.group(1)):
            raise StudyError(f"'{text}' is not a number with a unit, nor a sum such as \"0.5 * pressure + 2 kPa\"")
        result.append((-1.0 if sign.group(1) == "-" else 1.0, term))
        position = term.end()
    if not result:
        raise StudyError("an empty text is no quantity")
    return result


def _read_term(
    term: Mapping[str, Any], text: str, quantity: str, known: Mapping[str, int], parameters: Sequence[Parameter]
) -> tuple[float, str | None]:
    """Number (SI) and parameter's name, if any, of one term."""
    unit = term["unit"]
    number = 1.0 if term["number"] is None else possible(float(term["number"]), text)
    name = term["factor"] or term["name"]
    if name is not None and name not in known:
        listed = f"the parameters are {', '.join(known)}" if known else "the study has no parameters"
        divided = name.partition("/")[0]
        hint = f'; numbers that divide become factors, "0.5 * {divided}" for its half' if divided in known else ""
        raise StudyError(f"'{text}' names '{name}', which is no parameter; {listed}{hint}")
    measured = "ratio" if name is None else parameters[known[name]].quantity
    share = 1.0
    if term["divisor"] is not None:
        share, measured = _share(term, text, quantity, known, parameters), "ratio"
    if unit is not None:
        value = to_si(number, unit, quantity) * share
        if name is not None and measured != "ratio":
            raise StudyError(
                f"'{text}': only a parameter without unit can be multiplied by {term['number']} {unit}; "
                f'make it one with "{name} / 1 {parameters[known[name]].unit}"'
            )
        return value, name
    value = number * share
    if name is None:
        if quantity != "ratio":
            raise StudyError(f"'{text}' lacks a unit of {quantity}: {', '.join(FACTORS[quantity])}")
        return value, None
    if FACTORS[measured] is not FACTORS[quantity]:
        raise StudyError(
            f"'{text}': the parameter {name} is of {measured}, and {quantity} is wanted here: "
            f"write {_proportional(quantity, parameters[known[name]])}"
        )
    return value, name


def _share(
    term: Mapping[str, Any], text: str, quantity: str, known: Mapping[str, int], parameters: Sequence[Parameter]
) -> float:
    """One over the quantity that a parameter, which measures the same, is divided by."""
    divisor, name = possible(float(term["divisor"]), text), term["factor"] or term["name"]
    if name is None or not divisor:
        raise StudyError(f"'{text}': only a parameter can be divided, and not by zero")
    parameter = parameters[known[name]]
    try:
        return 1.0 / to_si(divisor, term["divisor_unit"], parameter.quantity)
    except StudyError as error:
        raise StudyError(
            f"'{text}': {error}, for {name} is divided by a quantity of its own kind; write "
            f"{_proportional(quantity, parameter)}"
        ) from None


def _proportional(quantity: str, parameter: Parameter) -> str:
    """How a quantity that is proportional to a parameter is written."""
    unit = next(iter(FACTORS[quantity]))
    factor = "" if quantity == "ratio" else f"10 {unit} * "
    divisor = "" if parameter.quantity == "ratio" else f" / 1 {parameter.unit}"
    return f'"{factor}{parameter.name}{divisor}" for example'
