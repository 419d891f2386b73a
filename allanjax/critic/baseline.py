"""The baseline of a critique as the first view of an axis, and the model that its findings extend."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.noise import RAMP, family_of
from allanjax.critic.search import Search
from allanjax.critic.view import EVERYTHING, View
from allanjax.estimate.deterministic import lines_of, take_out_lines, without_lines
from allanjax.noise.model import Model
from allanjax.noise.terms import DriftRamp
from allanjax.record.completion import in_time
from allanjax.record.recording import Axis


def view_of(
    axis: Axis,
    scale: float,
    x: Float[np.ndarray, " n"],
    rate: float,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
    baseline: tuple[Model, Model] | None,
    drawn: Bool[np.ndarray, " n"] | None = None,
) -> View:
    """First view of an axis; terms of the baseline other than basic ones are subtracted or in the factor.

    The baseline is a fitted model and the template of its terms; None: all basic terms are allowed. Samples
    that were missing are `drawn`.
    """
    n = len(x)
    drawn = np.zeros(n, bool) if drawn is None else drawn
    family = family_of(n, rate)
    if baseline is None:
        return View(axis, scale, rate, x, x, None, auxiliary, EVERYTHING, family, drawn, drawn=drawn)
    model, template = baseline
    allowed = tuple(name for name in template.term_labels if name in EVERYTHING)
    basic = [name for name in model.term_labels if name in EVERYTHING]
    others = further_terms(model)
    y, density = x, np.zeros(n - 1)
    for term in others.terms:
        if not term.deterministic:
            density += family.spectrum(term.sampled(rate))
    if any(term.deterministic for term in others.terms):
        y = _without_deterministic(others, x, rate)
    factor = None
    if density.any():
        noise = np.zeros(n - 1)
        for name in basic:
            if name != RAMP:
                noise += family.spectrum(model[name].sampled(rate))
        factor = 1.0 + density / np.maximum(noise, 1e-12 * density)
    # A baseline without basic noise still needs some to be compared with.
    if not set(allowed) - {RAMP}:
        allowed = ("angle_random_walk", *allowed)
    return View(axis, scale, rate, x, y, factor, auxiliary, allowed, family, drawn, drawn=drawn)


def further_terms(model: Model) -> Model:
    """Model without its basic terms."""
    return model.without([name for name in model.term_labels if name in EVERYTHING])


def _without_deterministic(model: Model, x: Float[np.ndarray, " n"], rate: float) -> Float[np.ndarray, " n"]:
    """Record from which a baseline's lines and transients are subtracted, by least squares."""
    lines, wanted = lines_of(model)
    y = x - x.mean()
    t = (np.arange(len(x)) + 0.5) / rate
    columns = [
        np.asarray(term.column(t))
        for k, term in enumerate(model.terms)
        if term.deterministic and k not in lines
    ]
    if columns:
        D = np.column_stack(columns)
        D = D - D.mean(axis=0)
        y = y - D @ np.linalg.lstsq(D, y, rcond=None)[0]
    if lines:
        y = in_time(without_lines(*take_out_lines(y, rate, wanted), rate))
    return y + x.mean()


def basic_model(view: View, random: Model | None = None) -> Model:
    """Model of a view's basic terms with their values, or with these in place of the random ones."""
    model = random or view.noise.model()
    if not view.noise.ramp:
        return model
    return model + DriftRamp(abs(view.slope), sign=int(np.copysign(1.0, view.slope)))


def extended(search: Search) -> tuple[Model, tuple[str, ...]]:
    """Model of an axis with all findings, and the effects that no model term can describe."""
    model, left_out = basic_model(search.end, search.noise_model), []
    for step in search.steps:
        before, model = model, step.candidate.add_to_model(model)
        if model is before and step.candidate.domain == "time" and step.change.path is not None:
            left_out.append(step.candidate.cause)
    return (model if search.others is None else model + search.others), tuple(dict.fromkeys(left_out))
