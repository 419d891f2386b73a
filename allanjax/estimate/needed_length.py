"""How long to record for a coefficient to be known well enough: the Cramér–Rao bound by the record's length.

The levels c_j² of the cosine spectrum (see `spectrum.cosine`) are independent and χ² with one degree of
freedom around the density S(f_j), f_j = j·rate/2n, j = 1 … n−1. So the Fisher information that n samples have
of the logarithms of the parameters θ is

    F_ab = ½ Σ_j (∂ ln S_j/∂ ln θ_a)(∂ ln S_j/∂ ln θ_b),

and no unbiased estimate of θ_a has a relative standard deviation below √[F⁻¹]_aa. More length means lower
frequencies, where slow terms show, and more levels at all others.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain, significant
from allanjax.estimate.result import AxisFit
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter, NoiseTerm
from allanjax.noise.terms import AngleRandomWalk, BiasInstability, DriftRamp, RateRandomWalk

#: Relative standard deviation at which a coefficient is taken to be known.
TARGET = 0.2
#: Longest recording that is proposed [s]: a month.
LONGEST = 30.0 * 86400.0
# Coefficients that a length is told for.
_ASKED: tuple[type[NoiseTerm], ...] = (AngleRandomWalk, BiasInstability, RateRandomWalk)
# Levels up to this one count one by one, further ones in so many groups an octave.
_SINGLE, _PER_OCTAVE = 256, 32
# Step of the logarithm of a parameter in a derivative: downwards, for some bandwidths have an upper bound.
_STEP = 1e-4
# Samples of the shortest record that is considered, and the relative accuracy of a length.
_SHORTEST, _ACCURACY = 64, 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class NeededLength(ByValue):
    """How well a coefficient is known, and the length of a recording that makes it known to ± 20 % (1 σ).

    Attributes:
        coefficient: the estimate of N, B or K [SI].
        relative_std: its relative standard deviation now; nan where it is not detected, or not measured.
        now: length [s] that was fitted.
        seconds: length [s] at which the Cramér–Rao bound is 20 %, of a coefficient that is not detected one
            as large as its 95 % limit; None if that is more than a month, or cannot be said.
        reason: why it cannot be said; "" if it can.
    """

    coefficient: Estimate
    relative_std: float
    now: float
    seconds: float | None
    reason: str = ""

    @property
    def known(self) -> bool:
        """Whether the coefficient is known to ± 20 % already."""
        return self.relative_std <= TARGET

    def __str__(self) -> str:
        return f"{self.coefficient.axis.name} {self.told()}"

    def told(self) -> str:
        """What it takes, in words without the axis's name."""
        takes = f"± {100.0 * TARGET:.0f} % takes " + (
            duration(self.seconds) if self.seconds else "over a month"
        )
        if not math.isnan(self.relative_std):
            known = f"known to ± {plain(100.0 * self.relative_std, 2)} %"
            return known if self.known else f"{known}, {self.reason or takes}"
        if self.reason:
            return f"cannot be said: {self.reason}"
        c = self.coefficient.in_unit()
        below = f"not detected, below {significant(c.upper_limit or 0.0)} {c.unit} (95 %)"
        if self.seconds is not None and self.seconds <= self.now:
            return f"{below}: one so large would usually show by now"
        return f"{below}: {takes} if it is so large"


def needed_lengths(result: AxisFit, n: int, rate: float) -> tuple[NeededLength, ...]:
    """What it takes to know N, B and K of an axis, given its fit to n samples at `rate` [Hz].

    Where the fit's standard deviation exceeds the bound at its own length, lengths allow for the ratio.
    """
    if not result.converged:
        return ()
    wanted = (term.name() for term in _ASKED)
    return tuple(_needed(result, result[label], n, rate) for label in wanted if label in result.coefficients)


def _needed(result: AxisFit, c: Estimate, n: int, rate: float) -> NeededLength:
    """What it takes to know one coefficient of an axis."""
    now = n / rate
    if not result.measured:
        return NeededLength(c, math.nan, now, None, "the fit is no measurement of this sensor")
    if c.detected and c.value > 0.0 and np.isfinite(c.std):
        std = c.std / c.value
        if std <= TARGET:
            return NeededLength(c, std, now, now)
        if result.discrepancy > 0.0:
            why = "the noise terms do not follow the data: how long ± 20 % takes cannot be said"
            return NeededLength(c, std, now, None, why)
        # The fit cannot do better than the bound, and at longer lengths is as much worse as here.
        target = TARGET * min(relative_std(result.model, n, rate)[c.label] / std, 1.0)
        return NeededLength(c, std, now, length_for(result.model, c.label, rate, target))
    if c.upper_limit is None or not c.upper_limit > 0.0:
        return NeededLength(c, math.nan, now, None, "there is no limit to it")
    term = next(term for term in _ASKED if term.name() == c.term)
    name = term.amplitude_parameter().name
    there = result.model.without([c.term]) if c.term in result.model.term_labels else result.model
    at_limit = there + term().replace(**{name: c.upper_limit})
    return NeededLength(c, math.nan, now, length_for(at_limit, c.term, rate))


def length_for(model: Model, label: str, rate: float, target: float = TARGET) -> float | None:
    """Length [s] at which the bound of a parameter's relative standard deviation is `target`.

    None if that is more than `LONGEST`.

    Raises:
        AllanjaxError: the model has no such parameter with a value.
    """

    def bound(n: float) -> float:
        found = relative_std(model, round(n), rate)
        if label not in found:
            raise AllanjaxError(f"the model has no {label!r} to be known; it has {', '.join(found)}")
        return found[label]

    low, high = float(_SHORTEST), max(LONGEST * rate, _SHORTEST + 1.0)
    if bound(low) <= target:
        return low / rate
    if bound(high) > target:
        return None
    while high / low > 1.0 + _ACCURACY:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if bound(middle) <= target else (middle, high)
    return high / rate


def relative_std(model: Model, n: int, rate: float) -> dict[str, float]:
    """Cramér–Rao bound of the relative standard deviation of each parameter, from n samples at `rate` [Hz].

    All parameters with a value are taken as unknown, but for held ones, and those of lines and of other
    deterministic terms, which take at most a level each. It is inf for what n samples say nothing of.
    """
    first, last = _groups(n, 2 if any(isinstance(term, DriftRamp) for term in model.terms) else 1)
    frequency, count = (first + last) * rate / (4.0 * n), last - first + 1
    random = model.without(
        [label for label, term in zip(model.term_labels, model.terms, strict=True) if term.deterministic]
    )
    values = {
        p.label: float(p.start) for p in random.parameters if p.start is not None and _counts(random, p)
    }
    labels = list(values)

    def log_density(label: str, factor: float) -> Float[np.ndarray, " m"]:
        moved = random.with_values(**{label: values[label] * factor})
        return np.log(np.asarray(moved.sampled(rate).sampled_psd(frequency, rate)))

    here = log_density(labels[0], 1.0)
    D = np.stack([(here - log_density(label, math.exp(-_STEP))) / _STEP for label in labels], axis=1)
    return dict(zip(labels, _bound(0.5 * (D.T * count) @ D), strict=True))


def _counts(model: Model, p: ModelParameter) -> bool:
    """Whether a parameter is unknown: finite, not zero, not held; numbers such as an order are known."""
    owner = model.response if p.term == len(model.terms) else model.terms[p.term]
    known = owner is None or p.parameter.name in owner.held or p.parameter.kind == "number"
    return not known and bool(np.isfinite(p.start or 0.0) and p.start)


def _bound(F: Float[np.ndarray, "params params"]) -> Float[np.ndarray, " params"]:
    """Square roots of the diagonal of the inverse of a Fisher matrix; inf where it has no information."""
    size = np.sqrt(np.diag(F))
    informed = size > 1e-6
    bound = np.full(len(F), np.inf)
    scaled = F[np.ix_(informed, informed)] / np.outer(size[informed], size[informed])
    values, vectors = np.linalg.eigh(scaled)
    variance = (vectors**2 / np.maximum(values, 1e-12)).sum(axis=1)
    bound[informed] = np.sqrt(variance) / size[informed]
    return bound


def _groups(n: int, first: int) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """First and last of the levels in each group, from level `first` to n − 1."""
    single = np.arange(first, min(_SINGLE, n - 1) + 1)
    octaves = max(math.log2(n / _SINGLE), 0.0)
    further = (_SINGLE + 1) * 2.0 ** np.arange(0.0, octaves, 1.0 / _PER_OCTAVE)
    starts = np.unique(np.concatenate([single, np.rint(further).astype(int)]))
    starts = starts[starts < n]
    return starts, np.append(starts[1:] - 1, n - 1)
