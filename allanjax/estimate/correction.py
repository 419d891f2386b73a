"""What a fit was corrected for, in words: filter, resonances and lines besides the plain noise terms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from allanjax.base.wording import plain, significant
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, Resonance, Sinusoid, basic_terms

# Ratio of a limit of the bandwidth to its value within which the limit is told.
_NEAR = 3.0
# Places that are named; of more the strongest.
_NAMED = 3


def further_terms(template: Model) -> tuple[str, ...]:
    """Labels of a model's terms that are neither basic ones nor Markov processes, and of its response."""
    kinds = {type(term) for term in basic_terms()} | {Markov}
    labels = zip(template.term_labels, template.terms, strict=True)
    response = () if template.response is None else (template.response.name(),)
    return (*(label for label, term in labels if type(term) not in kinds), *response)


def correction_of(
    template: Model, found: Model, after: Estimate, before: Estimate | None, bandwidth: Estimate | None
) -> str:
    """Words such as "corrected for a 28 Hz bandwidth and a resonance at 20 Hz: … 2.41 → 2.27 deg/√h".

    Args:
        template: the model that was fitted.
        found: the model with its values.
        after, before: N of this fit and of the fit without correction.
        bandwidth: of the response, if there is one.
    """
    causes = _bandwidth(found, bandwidth)
    causes += _places(found, Resonance, "resonance") + _places(found, Sinusoid, "line")
    if not causes:
        several = sum(isinstance(term, Markov) for term in template.terms) > 1
        causes = ["Markov processes of several correlation times" if several else "a Markov process"]
    text = f"corrected for {_listed(causes)}"
    if before is None or not (after.value > 0.0 and before.value > 0.0):
        return text
    new, old = after.in_unit(), before.in_unit()
    return f"{text}: {new.title} {significant(old.value, 3)} → {significant(new.value, 3)} {new.unit}"


def _bandwidth(found: Model, estimate: Estimate | None) -> list[str]:
    """The response in words: a limit is no bandwidth, and a value that the data do not determine is none."""
    if found.response is None or estimate is None:
        return []
    if np.isfinite(estimate.std) or estimate.held:
        return [f"a {plain(found.response.half_power, 3)} Hz bandwidth"]
    for side, limit in (("above", estimate.lower_limit), ("below", estimate.upper_limit)):
        # A limit far from the value says nothing.
        if limit is not None and 1.0 / _NEAR < limit / found.response.half_power < _NEAR:
            return [f"a bandwidth {side} {plain(limit, 3)} Hz"]
    return ["a filter of undetermined bandwidth"]


def _places(found: Model, kind: type[Resonance] | type[Sinusoid], name: str) -> list[str]:
    """Frequencies of the terms of one kind in words, at most three of them."""
    terms = [term for term in found.terms if isinstance(term, kind)]
    if not terms:
        return []
    strongest = sorted(terms, key=lambda term: -float(term.amplitude or 0.0))[:_NAMED]
    places = _listed([plain(f, 3) for f in sorted(float(term.frequency or 0.0) for term in strongest)])
    more = f" ({len(terms)} in all)" if len(terms) > _NAMED else ""
    return [f"{'a ' + name if len(terms) == 1 else name + 's'} at {places} Hz{more}"]


def _listed(words: Sequence[str]) -> str:
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
