"""Identification: the parameters for which a reduced model predicts what was measured best.

Weighted least squares over all measurements, each in units of its noise. Standard deviations allow for errors that
belong together, as those of one state, and for what tables do not know of themselves (`scatter`); curves that differ as
a whole are weighted and count as such (`curve_factors`). To that come what was known before, with its own deviation,
and errors e of the model and of a run's states, by (J'J)^-1 J'e. Intervals are Student's for what scatters, and normal
for the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import norm, qmc

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.identification.common_errors import stacked
from morph_dslam.identification.curve_factors import CurveFactors, curve_factors, noise_within
from morph_dslam.identification.doubts import check_size
from morph_dslam.identification.found import Estimate, Identification, Misfit
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measurements import Measurement
from morph_dslam.identification.prior import KnownValues
from morph_dslam.identification.scatter import Design, Noise, Scatter, directions, joint_labels, wider, without
from morph_dslam.identification.values import FACTOR, Values
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.flat_sides import FLAT_SHARE, LOOK, flat_variance
from morph_dslam.tracking.observability import UNOBSERVABLE_SHARE

if TYPE_CHECKING:
    from morph_dslam.identification.given_loads import GivenLoads

Array = NDArray[np.float64]
#: Range of the common factor of all moduli.
FACTOR_RANGE = (0.01, 100.0)
#: Starts of the search, so that it does not end in a local minimum (a power of two); most rounds of weighting, which
#: end when no noise changes by more than this share.
STARTS, ROUNDS, SETTLED = 8, 12, 0.01
#: Sums of squares that differ by less than this share are alike.
ALIKE = 1e-6
#: An estimate so near to an end of its range, over the range, is at it.
AT_THE_END = 1e-6
#: Values of a parameter at which the whole range is searched for others that fit as well.
PLACES = 49
#: Logarithms of factors are cut here.
LARGEST = 700.0


@dataclass(frozen=True)
class _Spread:
    """Covariances (k, k) of estimates over their ranges: by what scatters, what was known before, the model, and the
    states of a run.

    ``groups`` is the number of those whose errors count as independent.
    """

    scatter: Scatter
    known: Array
    model: Array
    run: Array
    groups: int

    @property
    def covariance(self) -> Array:
        return self.scatter.covariance + self.known + self.model + self.run

    @property
    def half(self) -> Array:
        """Half the width (k,) of 95 % intervals."""
        return np.sqrt(self.scatter.half**2 + float(norm.ppf(0.975)) ** 2 * np.diag(self.known + self.model + self.run))


@one_thread_for_algebra
def identify(
    model: ReducedModel,
    measurements: Sequence[Measurement],
    parameters: Sequence[str] = (),
    moduli: bool = False,
    prior: KnownValues | None = None,
) -> Identification:
    """The parameters for which the model predicts the measurements best.

    Parameters
    ----------
    model : whose parameters are identified; those that are neither identified nor known keep their defaults.
    measurements : see `measurements`.
    parameters : names of those to identify.
    moduli : whether a common factor of all moduli is identified too: it scales the forces, and divides the parameters
        to which loads of the study are proportional (`given_loads`).
    prior : of parameters that are known already, as from pictures; those that are not identified do not count.

    Raises
    ------
    IdentificationError
        If a parameter is not the model's, nothing measured depends on one, forces are of another size than any of
        the model, or loads act that a factor of all moduli does not scale, or that it takes out of their ranges.
    EvaluationError
        If the force that fits best falls where the measured one grows: it is that in the opposite direction.
    """
    unknowns = _unknowns(model, parameters, moduli)
    prior = prior or KnownValues.none()
    if not measurements and not prior.names:
        raise IdentificationError("nothing was measured: give points or forces")
    loads = _loads(model, measurements, parameters) if moduli else None
    fit = _Fit(model, unknowns, measurements, prior, frozenset() if loads is None else loads.scaled)
    found = replace(fit.result(fit.best()), loads=loads)
    for misfit in found.misfits:
        # Only now, for the sign of a force may depend on what is identified.
        if isinstance(misfit.measurement, MeasuredForces):
            misfit.measurement.compared.check_growth(misfit.predicted, misfit.measurement.values)
            taken = found.size_factor(misfit.measurement)
            at_end = moduli and found[FACTOR].at_bound
            check_size(misfit.measurement, misfit.predicted, 1.0 if taken is None else taken, at_end)
    return found


def _unknowns(model: ReducedModel, names: Sequence[str], moduli: bool) -> list[Parameter]:
    known = {parameter.name: parameter for parameter in model.parameters}
    if strange := next((name for name in names if name not in known), None):
        raise IdentificationError(f"the model '{model.name}' has no parameter '{strange}'; it has {', '.join(known)}")
    factor = Parameter(FACTOR, "ratio", "1", *FACTOR_RANGE, 1.0, "factor of all moduli")
    unknowns = [known[name] for name in dict.fromkeys(names)] + [factor] * moduli
    if not unknowns:
        raise IdentificationError("nothing is to be identified: name parameters, or ask for the factor of all moduli")
    return unknowns


def _loads(model: ReducedModel, measurements: Sequence[Measurement], parameters: Sequence[str]) -> GivenLoads:
    """Loads of given size beside a factor of all moduli; IdentificationError where it cannot be found with them."""
    # Studies take long to load.
    from morph_dslam.identification.given_loads import GivenLoads

    loads = GivenLoads.of(model)
    # Points alone show the factor by the loads that it divides.
    is_unseen = not loads.scaled and not any(isinstance(each, MeasuredForces) for each in measurements)
    for measurement in measurements:
        varied = measurement.given | set(parameters)
        # The free zero of a load cell takes up what stays the same.
        is_force = isinstance(measurement, MeasuredForces)
        is_absolute = not measurement.free_zero if is_force else is_unseen
        for load in loads.unscaled:
            steady = load.is_steady and not load.parameters & varied
            if is_absolute or not steady:
                free = "Leave the zero of the load cell free (no --no-offset), or make"
                advice = free if steady and is_force else "Make"
                raise IdentificationError(
                    f"{load.name} of the study does not grow with the moduli, and {measurement.name} depends on it: "
                    f"one factor of all moduli cannot be found. {advice} a modulus a parameter of the study, and "
                    "identify that (--parameter)"
                )
    return loads


class _Fit:
    """One fit; ``theta`` (k,) are the unknowns over their ranges, from 0 to 1."""

    def __init__(
        self,
        model: ReducedModel,
        unknowns: Sequence[Parameter],
        measurements: Sequence[Measurement],
        prior: KnownValues,
        scaled: Collection[str] = (),
    ) -> None:
        self._model, self._unknowns, self._measurements = model, list(unknowns), list(measurements)
        self._scaled = scaled
        names = [parameter.name for parameter in unknowns]
        self._prior = prior.of(names)
        self._is_known = np.array([names.index(name) for name in self._prior.names], dtype=np.int64)
        self._whitening = self._prior.whitening()
        # A factor that may be a hundredth or a hundred is looked for by its logarithm.
        self._log = np.array([p.name == FACTOR for p in unknowns])
        ends = np.array([(p.lower, p.upper) for p in unknowns])
        self._ends = np.where(self._log[:, None], np.log(np.maximum(ends, 1e-300)), ends)
        self._noise = np.ones(len(self._measurements))
        self._factors = CurveFactors(0.0, [np.zeros(len(each.values)) for each in self._measurements])
        self._groups = joint_labels([each.groups for each in self._measurements])

    @property
    def _curves(self) -> NDArray[np.int64]:
        """Labels (n,) that give each curve one group."""
        labels = [np.zeros_like(m.groups) if isinstance(m, MeasuredForces) else m.groups for m in self._measurements]
        return joint_labels(labels)

    def _si(self, theta: Array) -> Array:
        inner = self._ends[:, 0] + theta * np.diff(self._ends, axis=1)[:, 0]
        # An interval may be wider than numbers reach.
        return np.where(self._log, np.exp(np.where(self._log, np.clip(inner, -LARGEST, LARGEST), 0.0)), inner)

    def _values(self, theta: Array) -> Values:
        return Values(self._model, self._unknowns, self._si(theta), self._scaled)

    def _predictions(self, theta: Array) -> list[tuple[Array, Array]]:
        """Of each measurement, (n,) without and with what is not known of the measurement itself."""
        values = self._values(theta)
        raw = [measurement.predict(values) for measurement in self._measurements]
        return [(own, each.adjusted(own)) for own, each in zip(raw, self._measurements, strict=True)]

    def _missed(self, theta: Array) -> list[Array]:
        """Predicted minus measured values (n,) of each measurement."""
        pairs = zip(self._predictions(theta), self._measurements, strict=True)
        return [predicted - measurement.values for (_, predicted), measurement in pairs]

    def _residuals(self, theta: Array) -> Array:
        """What was known before comes last."""
        return np.concatenate([self._whitened(np.concatenate([*self._missed(theta), []])), self._away(theta)])

    def _away(self, theta: Array) -> Array:
        """From what was known before, in units of its deviation (p,)."""
        return self._whitening @ (self._values(theta).shown(self._prior.names) - self._prior.values)

    def _whitened(self, values: Array) -> Array:
        """Values (n, ...) of all measurements, SI, with independent errors of size 1."""
        begin, parts = 0, [values[:0]]
        for at, (measurement, noise) in enumerate(zip(self._measurements, self._noise, strict=True)):
            rows = slice(begin, begin + len(measurement.values))
            parts.append(self._factors.whitened(at, values[rows], float(noise)))
            begin = rows.stop
        return np.concatenate(parts)

    def best(self) -> Array:
        """The unknowns that fit best, over their ranges; measurements are weighted by the noise that they show."""
        k = len(self._unknowns)
        starts = 0.05 + 0.9 * qmc.Sobol(k, scramble=False).random(STARTS)
        middle = np.full(k, 0.5)
        self._noise = np.maximum(self._changes(middle), self._least())
        ends = [self._solved(start) for start in (middle, *starts)]
        # Of ends that fit alike, as all along a valley, the first: rounding must not choose.
        most = (1.0 + ALIKE) * min(cost for cost, _ in ends)
        found = next(end for cost, end in ends if cost <= most)
        for _ in range(ROUNDS):
            before = np.append(self._noise, self._factors.std)
            self._weigh(found)
            found = self._solved(found)[1]
            # One table alone has the same weight whatever its noise is.
            changes = np.abs(np.append(self._noise, self._factors.std) - before)
            if len(self._measurements) + len(self._is_known) < 2 or np.all(changes <= SETTLED * before):
                break
        return found

    def _weigh(self, theta: Array) -> None:
        """Weight measurements by what they show: their noise, and how far whole curves differ."""
        missed, ways, least = self._missed(theta), self._ways(theta), self._least()
        self._factors = CurveFactors(0.0, ways)
        if sum(way.any() for way in ways) > 1:
            before, within = self._noise, self._shown(theta, by_curve=True)
            self._noise = np.maximum(within.std, least)
            errors = self._whitened(self._state_errors(theta).T).T
            self._factors = curve_factors(
                self._design(theta), missed, ways, self._stated(theta, ways), errors, replace(within, std=self._noise)
            )
            if self._factors.std > 0.0:
                return
            self._noise = before
        self._noise = np.maximum(self._shown(theta).std, least)

    def _stated(self, theta: Array, ways: Sequence[Array]) -> float:
        """Relative standard deviation of the model's forces; it may differ from curve to curve."""
        values, tables = self._values(theta), zip(self._measurements, ways, strict=True)
        sizes = [(float(np.linalg.norm(each.model_errors(values))), float(np.linalg.norm(way))) for each, way in tables]
        return max((error / size for error, size in sizes if size > 0.0), default=0.0)

    def _ways(self, theta: Array) -> list[Array]:
        """Of each measurement (n_j,), what a factor of a whole force curve changes; zeros of points."""
        pairs = zip(self._measurements, self._predictions(theta), strict=True)
        return [
            without(raw[:, None], directions(each.loose(raw)))[:, 0]
            if isinstance(each, MeasuredForces)
            else np.zeros(len(raw))
            for each, (raw, _) in pairs
        ]

    def _changes(self, theta: Array) -> Array:
        """By how much the load changed the values of each measurement, (m,); those of one unit are alike."""
        units, values = [each.unit for each in self._measurements], self._values(theta)
        changes: dict[str, Array] = {}
        for unit, each in zip(units, self._measurements, strict=True):
            own = each.changes(each.predict(values))
            changes[unit] = np.concatenate([changes.get(unit, own[:0]), own])
        return np.array([root_mean_square(changes[unit]) for unit in units])

    def _least(self) -> Array:
        """Noise (m,) of values that are predicted to rounding: they must not get all the weight."""
        return np.array([1e-6 * max(float(np.abs(m.values).max()), 1e-300) for m in self._measurements])

    def _shown(self, theta: Array, by_curve: bool = False) -> Noise:
        """The noise that residuals show; ``by_curve`` within curves that have a factor each."""
        units, missed, design = [each.unit for each in self._measurements], self._missed(theta), self._design(theta)
        if by_curve:
            return noise_within(design, missed, self._ways(theta), units, self._changes(theta), self._noise)
        return Noise.shown(design, missed, units, self._changes(theta))

    def _design(self, theta: Array) -> Design:
        pairs = zip(self._predictions(theta), self._measurements, strict=True)
        loose = [directions(each.loose(predicted)) for (_, predicted), each in pairs]
        slopes = self._whitened(self._slopes(theta))
        return Design(slopes, self._differences(self._away, theta), loose, self._groups)

    def _solved(self, start: Array) -> tuple[float, Array]:
        inside = np.clip(start, 1e-9, 1.0 - 1e-9)
        solution = least_squares(self._residuals, inside, jac="3-point", bounds=(0.0, 1.0), xtol=1e-12, ftol=1e-12)
        return float(solution.cost), np.asarray(solution.x, dtype=np.float64)

    def result(self, theta: Array) -> Identification:
        """Estimates with deviations."""
        at_bound = (theta < AT_THE_END) | (theta > 1.0 - AT_THE_END)
        self._check_inside(theta)
        theta = np.where(at_bound, np.round(theta), theta)
        jacobian, by_model, by_run = self._jacobian(theta), self._model_errors(theta), self._state_errors(theta)
        silent = [p.name for p, column in zip(self._unknowns, jacobian.T, strict=True) if not column.any()]
        if silent:
            given = " and ".join(m.name for m in self._measurements if m.run is None and silent[0] in m.given)
            raise IdentificationError(
                f"nothing that was measured depends on '{silent[0]}': leave it out, or measure something that does"
                + (f"; what {given} has of it is taken as known" if given else "")
            )
        residuals = self._residuals(theta)
        spread = self._spread(theta, residuals, by_model, by_run)
        alike, is_flat = self._alike(theta, jacobian, float(residuals @ residuals), spread)
        estimates = self._estimates(theta, spread, at_bound, alike, is_flat)
        std = np.sqrt(np.diag(spread.covariance))
        products = np.outer(std, std)
        # What is fitted without any error has no deviation.
        correlation = np.divide(spread.covariance, products, out=np.eye(len(std)), where=products > 0.0)
        misfits = self._misfits(theta, self._slopes(theta)[:, ~at_bound], by_model, by_run)
        return Identification(estimates, correlation, misfits, spread.groups, curve_std=self._factors.std)

    def _check_inside(self, theta: Array) -> None:
        """Refuse a factor of the moduli with which loads are, for the model, outside of their ranges."""
        for measurement in self._measurements:
            values = self._values(theta)
            measurement.predict(values)
            for parameter in self._model.parameters:
                if beyond := values.beyond.get(parameter.name):
                    ends = " to ".join(dict.fromkeys(parameter.text(end) for end in (min(beyond), max(beyond))))
                    raise IdentificationError(
                        f"with {FACTOR} = {values.factor:.3g} {measurement.name} is measured where the model would "
                        f"need {parameter.name} = {ends}, outside of its range, {parameter.range_text}: build it with "
                        "a wider one, or give what was measured at less load"
                    )

    def _alike(self, theta: Array, jacobian: Array, least: float, spread: _Spread) -> tuple[Array, NDArray[np.bool_]]:
        """How far (k, 2) below and above each estimate its range has values that fit nearly as well as ``least``.

        The way of a body that does not touch yet may be anything up to the contact. There the sum of squares rises by
        less than the derivatives say it does two standard deviations away. Where it rises by much less there, the
        derivatives do not hold: the side (k, 2) is flat, and not only curved.
        """
        found, is_flat = np.zeros((len(theta), 2)), np.zeros((len(theta), 2), dtype=bool)
        for i, away in enumerate(LOOK * np.sqrt(np.diag(spread.covariance))):
            rise = float(np.sum((away * jacobian[:, i]) ** 2))

            def risen(value: float, i: int = i) -> float:
                there = np.where(np.arange(len(theta)) == i, value, theta)
                return float(np.sum(self._residuals(there) ** 2)) - least

            for side, near in enumerate((theta[i] - away, theta[i] + away)):
                is_flat[i, side] = 0.0 <= near <= 1.0 and risen(near) < FLAT_SHARE * rise
            for value in np.linspace(0.0, 1.0, PLACES):
                if abs(value - theta[i]) > away and risen(value) < rise:
                    side = int(value > theta[i])
                    found[i, side] = max(found[i, side], abs(value - theta[i]))
        return found, is_flat

    def _estimates(
        self, theta: Array, spread: _Spread, at_bound: NDArray[np.bool_], alike: Array, is_flat: NDArray[np.bool_]
    ) -> tuple[Estimate, ...]:
        """Those with values that fit ``alike`` (k, 2) have wider intervals, and deviations on sides that are flat."""
        std, model, run = (np.sqrt(np.diag(part)) for part in (spread.covariance, spread.model, spread.run))
        below, above = np.maximum(spread.half[:, None], alike).T
        low, high, value = self._si(theta - below), self._si(theta + above), self._si(theta)
        std = np.sqrt(std**2 + flat_variance((alike * is_flat).max(axis=1)))
        # Over the factor's logarithm a deviation is a relative one.
        slope = np.where(self._log, value, 1.0) * np.diff(self._ends, axis=1)[:, 0]
        return tuple(
            Estimate(
                parameter,
                float(value[i]),
                float(slope[i] * std[i]),
                float(slope[i] * model[i]),
                float(slope[i] * run[i]),
                (max(float(low[i]), parameter.lower), min(float(high[i]), parameter.upper)),
                bool(at_bound[i]),
                bool(std[i] >= UNOBSERVABLE_SHARE),
            )
            for i, parameter in enumerate(self._unknowns)
        )

    def _misfits(self, theta: Array, slopes: Array, by_model: Array, by_run: Array) -> tuple[Misfit, ...]:
        """With ``slopes`` (n, f) of predictions, and errors (e, n) by the model and by a run, SI."""
        found, begin, by_range = [], 0, self._by_range(theta)
        for at, (measurement, (raw, predicted)) in enumerate(
            zip(self._measurements, self._predictions(theta), strict=True)
        ):
            rows = slice(begin, begin + len(raw))
            of_model, of_run = (root_mean_square(np.linalg.norm(part[:, rows], axis=0)) for part in (by_model, by_run))
            slope, at_value = slopes[rows], self._values(theta)
            found.append(
                Misfit(measurement, predicted, predicted - raw, slope, of_model, of_run, by_range[:, at], at_value)
            )
            begin = rows.stop
        return tuple(found)

    def _by_range(self, theta: Array) -> Array:
        """Root mean square changes (k, m) of the predictions of each measurement, over the range of each unknown."""
        changes = np.zeros((len(theta), len(self._measurements)))
        for i in range(len(theta)):
            below, above = (np.where(np.arange(len(theta)) == i, end, theta) for end in (0.0, 1.0))
            pairs = zip(self._predictions(below), self._predictions(above), strict=True)
            changes[i] = [root_mean_square(high - low) for (_, low), (_, high) in pairs]
        return changes

    def _model_errors(self, theta: Array) -> Array:
        """(e, n) of all measurements, SI; those of one unit have rows in common."""
        values, tables = self._values(theta), self._measurements
        return stacked([table.model_errors(values) for table in tables], [table.unit for table in tables])

    def _state_errors(self, theta: Array) -> Array:
        """(e, n) of all measurements, SI; those of one run have rows in common."""
        values, tables = self._values(theta), self._measurements
        return stacked([table.state_errors(values) for table in tables], [id(table.run) for table in tables])

    def _jacobian(self, theta: Array) -> Array:
        """Derivatives (n + p, k) of the residuals."""
        return self._differences(self._residuals, theta)

    def _slopes(self, theta: Array) -> Array:
        """Derivatives (n, k) of what is missed, SI."""
        return self._differences(lambda at: np.concatenate([*self._missed(at), []]), theta)

    def _differences(self, function: Callable[[Array], Array], theta: Array) -> Array:
        """Derivatives (n, k) of a function (n,) by central differences within the range."""
        columns = []
        for i in range(len(theta)):
            step = 1e-4 * np.eye(len(theta))[i]
            above, below = np.clip(theta + step, 0.0, 1.0), np.clip(theta - step, 0.0, 1.0)
            change = function(above) - function(below)
            columns.append(change / (above - below)[i])
        return np.column_stack(columns)

    def _spread(self, theta: Array, residuals: Array, by_model: Array, by_run: Array) -> _Spread:
        """Of estimates over their ranges, with errors (e, n), SI, by the model and by a run."""
        design, differ = self._design(theta), self._factors.std > 0.0
        noise, measured = self._shown(theta, by_curve=differ), len(design.slopes)
        shown = (residuals[:measured], (noise.std / self._noise) ** 2, noise)
        scatter, groups = Scatter.of(design, *shown), self._curves if differ else self._groups
        if differ:
            scatter = wider(scatter, Scatter.of(replace(design, groups=groups), *shown))
        # What was known before has the deviation that it came with, even if nothing contradicts it.
        before = design.known * np.maximum(np.abs(residuals[measured:]), 1.0)[:, None] @ design.inverse
        model, run = (self._whitened(part.T).T @ design.free @ design.inverse for part in (by_model, by_run))
        # Directions that the measurements do not see are as uncertain as can be.
        known = before.T @ before + design.unseen @ design.unseen.T
        return _Spread(scatter, known, model.T @ model, run.T @ run, len(np.unique(groups)) + len(self._is_known))
