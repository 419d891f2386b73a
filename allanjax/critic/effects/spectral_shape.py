"""A filter of all noise, and resonances: the structure of the spectrum besides the basic noise terms.

They are searched for together and fitted jointly with the noise (`estimate.spectral`); the findings are
described after the search, from the final model.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.optimize import approx_fprime
from scipy.special import gammaincc

from allanjax.base.arrays import seed_of
from allanjax.critic.bank import any_of
from allanjax.critic.effect import FREQUENCIES, Candidate, Effect, Place, View
from allanjax.critic.finding import Detail, Limit, limited
from allanjax.critic.noise import MARKOV, POWER_LAW, coefficient_folds, share_of_noise, spectrum_factor
from allanjax.critic.policy import judged
from allanjax.critic.step import Step
from allanjax.estimate.spectral import model as structures
from allanjax.estimate.spectral.as_model import model_of
from allanjax.estimate.spectral.components import BUTTERWORTH, NONE
from allanjax.estimate.spectral.model import FIXED, Fitted, Spectrum, Structure, response_of
from allanjax.estimate.spectral.search import (
    Record,
    at_all,
    at_some,
    completed,
    in_full,
    narrow,
    refitted,
    searched,
)
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.response import Response
from allanjax.noise.terms import PowerLaw
from allanjax.record.completion import in_time
from allanjax.spectrum.cosine import cosine_transform
from allanjax.spectrum.peaks import LOWEST, NARROWEST

# Number of independent windows per width, and its growth per e-fold of a smaller p-value; number of the
# widest windows that add nothing. Measured on simulated spectra.
_INDEPENDENT, _WIDE = (1.9, 0.11), 3.0


def chance_of_peak(ratio: Float[np.ndarray, " n-1"]) -> float:
    """p-value of the largest excess in any window of squared whitened coefficients.

    Windows a quarter of a width apart count as two to four independent ones for each width, the more the
    smaller the p-value (`_INDEPENDENT`).
    """
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    least, widths, width = 1.0, 0, NARROWEST
    while width <= (len(ratio) - LOWEST) // 4:
        step = max(width // 4, 1)
        excess = np.max(total[LOWEST + width :: step] - total[LOWEST : len(total) - width : step])
        tail = min(max(float(gammaincc(width / 2.0, excess / 2.0)), 1e-300), 1.0 - 1e-12)
        independent = min(_INDEPENDENT[0] - _INDEPENDENT[1] * np.log(tail), 4.0)
        least = min(least, any_of(tail, independent * len(ratio) / width))
        width, widths = 2 * width, widths + 1
    # Every width is a separate search, except that the widest ones repeat narrower ones.
    return any_of(least, max(widths - _WIDE, 1.0))


#: Names of the findings.
LOW_PASS, RESONANCE = "low_pass", "resonance"
_LINES, _BESIDE = judged("line", "quality"), judged("line", "beside")
# Share of a filter's corner frequency at which its pass band is judged.
_PASSED = 0.5
# Error of the logarithm of a bandwidth beyond which that is undetermined.
_VAGUE = float(np.log(10.0))
# Share of the record at each end that is drawn anew behind a steep filter.
_ENDS = 0.02
_LEFT = judged("spectral_shape", "left")
# Correlation time [samples] below which a Markov process without white noise is filtered white noise.
_SHORT = 20.0
# Evidence [nats] by which a likelier cause may be behind, and distance from whole samples that is none.
_AS_LIKELY, _WHOLE = 3.0, 5e-3
# Number of points of the response in the search for its half-power frequency, the share of half the sample
# rate up to which this is sought, and the step of derivatives.
_POINTS, _REACHED, _STEP = 4096, 0.8, 1e-3


def _problem(view: View, whole: bool = False) -> tuple[Record, Structure]:
    """Spectrum of a view without its baseline's other terms, and a structure with all that it may have.

    A Markov process that may be filtered white noise is left out, unless the `whole` noise is wanted.
    """
    noise, squares = view.noise, view.residual**2
    further = PowerLaw(1.0, noise.shape) if POWER_LAW in noise.power else None
    start = Structure.plain(k for k, name in enumerate(FIXED) if name in view.allowed)
    start = dataclasses.replace(start, further=further)
    time = noise.shape * view.rate
    # As filtered white noise it shows where the pass band ends.
    filtered = not whole and "angle_random_walk" not in noise.power and time < _SHORT
    for name, power in noise.power.items():
        if name != MARKOV:
            start = start.with_column(structures.FURTHER if name == POWER_LAW else FIXED.index(name), power)
        elif not filtered:
            start = start.plus(structures.markov(time, 0.5 * power * noise.shape))
    start = start if view.structure is None else start.with_shape_of(view.structure)
    return Record(squares if view.base is None else squares / view.base, view.rate, further), start


def candidate_structure(view: View) -> tuple[View, float] | None:
    """View with the structure of its spectrum beyond the findings, and its log odds [nats].

    It is that of the fit, if that has one; when everything else has been found, it is searched for once more
    if the spectrum is off (`finished`). The odds are against all basic terms, also missing ones: a Markov
    process may explain much of a filter.
    """
    if view.structure is not None and (view.fitted is not None or not _left(view)):
        return None
    record, start = _problem(view)
    if view.fitted is None:
        spectrum, found = searched(record, start)
    else:
        spectrum, found = refitted(record, start.with_shape_of(view.fitted))
    spectrum, found = in_full(spectrum, _of_resonances(spectrum, found, record.n))
    found = _with_what_is_known(view, spectrum, found)
    if found.structure.has_shape_of(start):
        return None
    before, after = spectrum.fit(start), view.with_structure(found.structure)
    after = after if start.kind != NONE else _without_ends(after)
    gain = found.evidence - before.evidence
    occam = before.loss - found.loss - gain
    gain = min(gain, after.log_evidence_all_terms - view.log_evidence_all_terms - occam)
    return (after, gain) if gain > 0.0 else None


def structure_at(view: View, places: Sequence[Place]) -> tuple[View, float] | None:
    """View with narrow resonances at some places, each known to the place's width; their log odds [nats]."""
    record, start = _problem(view)
    spectrum, now = refitted(record, start)
    total = 0.0
    for place in places:
        low, high = (2.0 * np.pi * f / record.rate for f in place[1:])
        angle, width = 0.5 * (low + high), high - low
        level = at_some(spectrum, now, np.clip(angle / np.pi * record.n, 1.0, record.n - 1.0))
        k, inside = len(now.structure.components), now.structure.kind != NONE
        power = 0.5 * float(level) * width / np.pi
        new = now.structure.plus(structures.resonance(angle, 2.0 * angle / width, power, inside))
        finer = record.binned(new)
        found = finer.fit(new)
        own, first = found.structure.components[k], found.structure.first[k]
        if own.power <= 0.0 or not low <= own.frequency <= high:
            continue
        before = finer.fit(now.structure)
        std = float(np.sqrt(found.covariance[first, first]))
        share = max(width / angle * len(places), np.sqrt(2.0 * np.pi) * std)
        gain = (
            found.evidence
            - before.evidence
            + float(np.log(np.log(record.n / structures.FREQUENCIES) / share))
        )
        if gain > 0.0:
            spectrum, now, total = finer, found, total + gain
    return (view.with_structure(now.structure), total) if total > 0.0 else None


def _with_what_is_known(view: View, spectrum: Spectrum, found: Fitted) -> Fitted:
    """Fit in which white noise after a response may be rounding, and a mean is over whole samples.

    The levels in a stop band hardly tell rounding from quantization, nor those near the zeros of a mean one
    over whole samples from one over nearly as many.
    """
    structure = found.structure
    place, kind = structure.place(structures.QUANTIZATION), structure.kind
    after = kind != NONE and place in structure.there and not structure.components[place].inside
    if after and view.rounding > 0.0:
        white = structure.without(place).with_column(structures.OUTSIDE, view.rounding)
        rounded = spectrum.fit(white)
        if rounded.evidence > found.evidence - _AS_LIKELY:
            found = rounded
    if kind.is_mean:
        samples = kind.of_one_sample / found.structure.corner
        nearest = np.rint(samples)
        if abs(samples / nearest - 1.0) < _WHOLE:
            exact = found.structure.with_response(kind, kind.of_one_sample / nearest)
            found = found._replace(structure=exact)
    return found


def _of_resonances(spectrum: Spectrum, found: Fitted, n: int) -> Fitted:
    """Structure without peaks as narrow as lines, and without those that may be the spectrum of one event."""
    own = found.structure
    # A resonance of ω per sample has ω·n/(2π) periods in the record.
    least = 2.0 * np.pi * judged(RESONANCE, "periods") / n
    single = [k for k in own.oscillators if own.components[k].frequency < least]
    others = {*narrow(own, n), *single}
    return spectrum.fit(own.without(*others)) if others else found


def _without_ends(view: View) -> View:
    """View whose ends are redrawn in the stop band of its response; they count as imputed.

    Whitening amplifies the stop band, and with it the kinks of the mirrored record. Noise as strong as what
    these add, but all over the record, is drawn in their place: it hides what is weaker.
    """
    if view.structure is None:
        return view
    factor, noise = spectrum_factor(view.structure, view.family)
    share = share_of_noise(view.structure, view.family, factor)
    if not (deep := share < 1.0).any():
        return view
    k = np.arange(view.n)
    # Gradually, as an edge would be an outlying sample.
    near = np.clip(1.0 - np.minimum(k, view.n - 1 - k) / (_ENDS * view.n), 0.0, 1.0)
    # Not by the view's own noise, which was estimated with the ends.
    root = np.sqrt(factor * noise * (1.0 if view.base is None else view.base))
    draws = np.random.default_rng(seed_of(view.samples))
    drawn, hiding, rounding = draws.standard_normal((3, view.n - 1))
    # What is rounding is not Gaussian.
    rounded = np.clip(view.rounding * view.rate / (factor * noise), 0.0, 1.0)
    drawn, hiding, white = np.sqrt(share) * drawn, np.sqrt(1.0 - share) * hiding, view.coefficients / root
    own, other = (in_time(np.where(deep, part, 0.0)) for part in (white, drawn))
    # Weights whose squares have a sum of one leave the level as it is.
    change = (np.cos(0.5 * np.pi * near) - 1.0) * own + np.sin(0.5 * np.pi * near) * other
    new = np.sqrt(1.0 - rounded) * (white + cosine_transform(change) + hiding) + np.sqrt(rounded) * rounding
    more = in_time(np.where(deep, root * (new - white), 0.0))
    return dataclasses.replace(view, samples=view.samples + more, imputed=view.imputed | (near > 0.0))


def _left(view: View) -> bool:
    """Whether the spectrum has a rest that its structure does not explain."""
    return chance_of_peak(view.squared_whitened) < _LEFT


def finished(view: View, found_so_far: Sequence[Step]) -> tuple[list[Step], View, Model | None]:
    """Final structure, found in some steps: filter and resonances as findings, the view with it; the model.

    There are no findings and there is no model if there are only basic terms. The steps lead from the view
    without the finding, the rest held, to the one with it.
    """
    left = _left(view)
    record, start = _problem(view)
    ramp = view.coefficients - view.residual
    # The ends are those of the record again, but the noise is that without them.
    for step in reversed(found_so_far):
        view = step.made(view, undone=True)
    squares = (view.coefficients - ramp) ** 2
    record = record._replace(squares=squares if view.base is None else squares / view.base)
    spectrum, found = _final(view, record, start, left)
    if not _groups(found.structure):
        # A peak may have been split into some that are as narrow as lines.
        spectrum, found = _final(view, record, start.without(*start.oscillators), True)
    while groups := _groups(found.structure):
        less = [_without(found.structure, group) for group in groups]
        best, *losses = _held_out_losses(record, spectrum, [found.structure, *less])
        if min(losses) > best:
            break
        # What predicts nothing is not reported.
        found = spectrum.fit(less[losses.index(min(losses))])
    else:
        return [], view.with_structure(None), None
    steps = []
    after = _without_ends(view.with_structure(found.structure)).without_caches()
    whole = after.structure
    assert whole is not None
    for group, rest, loss in zip(groups, less, losses, strict=True):
        refit = spectrum.fit(rest)
        if group == [_RESPONSE]:
            # For a filter, the odds are the only statistic.
            own, chance = _filter(view, found), None
        else:
            # Everything else is fitted to the spectrum without it.
            own = _resonance(view, found, group)
            chance = chance_of_peak(record.squares / at_all(spectrum, refit))
        gain = found.evidence - refit.evidence
        candidate = dataclasses.replace(own, gain=gain, p_value=chance, after=after)
        held = dataclasses.replace(after, structure=_without(whole, group))
        steps.append(Step(candidate, loss - best, (), held))
    steps.sort(key=lambda step: -step.candidate.gain)
    names = [*after.found, *(step.candidate.cause for step in steps)]
    return steps, after.with_findings(*names), model_of(found.structure, view.rate)


def _final(view: View, record: Record, start: Structure, anew: bool) -> tuple[Spectrum, Fitted]:
    """Spectrum and its final structure, searched for anew from a start or refitted."""
    spectrum, found = searched(record, start) if anew else refitted(record, start)
    found = _of_resonances(spectrum, found, record.n) if anew else found
    spectrum, found = completed(record, spectrum, found, MARKOV in view.allowed)
    return spectrum, _with_what_is_known(view, spectrum, _of_resonances(spectrum, found, record.n))


#: Represents the response among the components of a group.
_RESPONSE = -1


def _groups(structure: Structure) -> list[list[int]]:
    """The response, and resonances that belong together, as lists of components, the strongest first."""
    groups: list[list[int]] = []
    own = structure.components
    for k in sorted(structure.oscillators, key=lambda k: own[k].frequency):
        if groups and any(own[i].is_close_to(own[k]) for i in groups[-1]):
            groups[-1].append(k)
        else:
            groups.append([k])
    sharp = [g for g in groups if all(own[k].quality > _LINES for k in g)]
    if sharp:
        first = max(sharp, key=lambda g: max(own[k].power for k in g))
        # It, and those at a multiple of its frequency, or beside one.
        ratios = np.array([own[g[0]].frequency / own[first[0]].frequency for g in sharp])
        near = (ratios > 0.5) & (abs(ratios - np.rint(ratios)) < _BESIDE)
        family = [g for g, is_near in zip(sharp, near, strict=True) if is_near]
        groups = [g for g in groups if g not in family] + [[k for g in family for k in g]]
    places = [sorted(g, key=lambda k: -own[k].power) for g in groups]
    return ([[_RESPONSE]] if structure.kind != NONE else []) + places


def _without(structure: Structure, group: Sequence[int]) -> Structure:
    """Structure without a group of components."""
    rest = structure.without(*group)
    return dataclasses.replace(rest, kind=NONE) if _RESPONSE in group else rest


def held_out_gain(view: View, structure: Structure) -> float:
    """Gain in log-likelihood [nats] by a structure over all terms, on each half by fits to the other."""
    record, start = _problem(view, whole=True)
    before, after = _held_out_losses(record, record.binned(structure), [start, structure])
    return before - after


def _held_out_losses(record: Record, spectrum: Spectrum, structures: Sequence[Structure]) -> list[float]:
    """Minus the log-likelihood of each half of the coefficients under fits to the other half [nats]."""
    losses = np.zeros(len(structures))
    for fold in coefficient_folds(record.n):
        mine, other = (
            Spectrum.of(record.squares, spectrum.bins, record.further, half.astype(float)).with_error(
                spectrum.error
            )
            for half in (fold, ~fold)
        )
        losses += [other.loss_of(mine.fit(structure)) for structure in structures]
    return losses.tolist()


def _described(
    view: View, cause: str, estimates: Sequence[Estimate], support: tuple[float, float], doubt: str
) -> Candidate:
    """Filter or resonance without its gain, with the frequencies between which it matters [Hz]."""
    return Candidate(cause, estimates, np.nan, None, view, lambda: np.nan, support, "frequency", doubt=doubt)


def _filter(view: View, found: Fitted) -> Candidate:
    """Half-power frequency of the response, and its order."""
    structure, rate = found.structure, view.rate

    def log_corner(shape: Float[np.ndarray, " 2"]) -> float:
        response = response_of(dataclasses.replace(structure, response=tuple(shape)), rate)
        return float(np.log(_half_power(response, rate))) if response else np.nan

    shape = np.array(structure.response)
    log, slope = log_corner(shape), approx_fprime(shape, log_corner, _STEP)
    std = float(np.sqrt(slope @ found.covariance[-2:, -2:] @ slope))
    bounds = np.log([structures.LOWEST_BANDWIDTH * rate, rate])
    # Filters steeper than the steepest one in the search look like it.
    steepest: Limit = "above" if structure.kind == BUTTERWORTH[-1] else ""
    estimates = [
        view.log_estimate("bandwidth", *limited(log, std, bounds), "Hz"),
        view.estimate("order", structure.kind.order, 0.0, "1", steepest),
    ]
    corner = float(np.exp(log))
    doubt = _doubt_of_filter(structure, rate, corner)
    if not std < _VAGUE:
        doubt, estimates = "its bandwidth is undetermined", estimates[1:]
    return _described(view, LOW_PASS, estimates, (corner, rate / 2.0), doubt)


def _half_power(response: Response, rate: float) -> float:
    """Frequency at which the power of samples, or the analog filter's if aliases keep it up, is half [Hz]."""
    f = np.linspace(0.0, _REACHED * rate / 2.0, _POINTS)
    power = np.asarray(response.power(f, rate))
    k = int(np.argmax(power < 0.5))
    return float(np.interp(0.5, power[[k, k - 1]], f[[k, k - 1]])) if k else response.half_power


def _doubt_of_filter(structure: Structure, rate: float, corner: float) -> str:
    """Why a response with this corner [Hz] is hardly a low-pass filter."""
    if corner >= rate / 2.0:
        return "its corner would lie above half the sample rate"
    # Resonances may be what falls.
    smooth = model_of(structure.without(*structure.oscillators), rate)
    inside, highest = np.asarray(smooth.sampled_psd(np.array([_PASSED * corner, rate / 2.0]), rate))
    falls = highest < judged(LOW_PASS, "falls") * inside
    return "" if falls else "the spectrum does not fall above its corner"


def _resonance(view: View, found: Fitted, group: Sequence[int]) -> Candidate:
    """Resonances of one source: the strongest one with those close to it, and the others as details."""
    own = found.structure.components
    near = [k for k in group if own[k].is_close_to(own[group[0]])]
    others = sorted(set(group) - set(near), key=lambda k: own[k].frequency)
    estimates, support = _parameters(view, found, near)
    details: dict[str, Detail] = {}
    if others:
        frequencies, _, amplitudes = zip(*(_parameters(view, found, [k])[0] for k in others), strict=True)
        details = {"further_frequencies": frequencies, "further_amplitudes": amplitudes}
    broad = estimates[1].value < judged(RESONANCE, "quality")
    doubt = "it is too broad for a resonance" if broad else ""
    return dataclasses.replace(_described(view, RESONANCE, estimates, support, doubt), details=details)


def _parameters(
    view: View, found: Fitted, group: Sequence[int]
) -> tuple[list[Estimate], tuple[float, float]]:
    """Frequency, quality and amplitude of a resonance, or of several of one that drifts; its band [Hz]."""
    structure, rate = found.structure, view.rate
    own, shape = [structure.components[k] for k in group], np.array([structure.first[k] for k in group])
    frequency = np.array([c.frequency for c in own]) * rate / (2.0 * np.pi)
    quality, fitted = np.array([(c.quality, c.power) for c in own]).T
    power, response = fitted, response_of(structure, rate)
    if response is not None:
        # As recorded, after the response.
        power = np.where(structure.inside[group], power * response.power(frequency, rate), power)
    share, amplitude = power / power.sum(), np.sqrt(power.sum())
    f0 = float(share @ frequency)
    moved = np.sqrt(share @ (frequency - f0) ** 2)
    # The full width at half of the maximum of a normal law is 2.355 standard deviations.
    width = np.hypot(share @ (frequency / quality), 2.355 * moved)
    std = np.sqrt(np.diag(found.covariance))
    each = std[shape], std[shape + 1] * (1.0 - 0.5 / quality), 0.5 * std[group] / fitted
    f_std, q_std, a_std = (float(np.linalg.norm(share * x)) for x in each)
    # A narrower one is a line, a wider one an edge; lower or higher ones are not observable.
    spacing = rate / (2.0 * view.n)
    band, widths = (
        np.log([LOWEST * spacing, rate / 2.0]),
        np.log([structures.LEAST_QUALITY, f0 / (structures.LINE * spacing)]),
    )
    estimates = [
        view.log_estimate("frequency", *limited(np.log(f0), np.hypot(f_std, moved / f0), band), "Hz"),
        view.log_estimate("quality_factor", *limited(np.log(f0 / width), q_std, widths), "1"),
        view.amplitude_estimate("amplitude", amplitude, amplitude * a_std),
    ]
    reach = 2.0 * frequency / quality
    low, high = np.clip([min(frequency - reach), max(frequency + reach)], 0.0, rate / 2.0).tolist()
    return estimates, (low, high)


class SpectralShape(Effect):
    """A low-pass filter and resonances, or narrow resonances at given places."""

    name = "spectral_shape"
    sensible: ClassVar = {"bandwidth": FREQUENCIES}

    def p_value(self, view: View) -> float:
        return chance_of_peak(view.squared_whitened)

    def detect(self, view: View) -> Candidate | None:
        found = structure_at(view, self.places) if self.places else candidate_structure(view)
        if found is None:
            return None
        after, gain = found
        structure = after.structure
        assert structure is not None
        response = response_of(structure, view.rate)
        corner = [] if response is None else [view.estimate("bandwidth", response.half_power, np.nan, "Hz")]
        # For a filter, and at a known place, the odds are the only statistic.
        p_value = None if self.places or response is not None else self.p_value(view)
        return Candidate(
            self.name,
            corner,
            gain,
            p_value,
            after,
            lambda: held_out_gain(view, structure),
            domain="frequency",
            bound=float(np.exp(-gain)),
            is_shared=bool(self.places),
        )
