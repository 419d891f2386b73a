"""Tests of many hypotheses at once."""

from __future__ import annotations

from collections.abc import Sequence


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """p-values corrected for their number (Holm 1979, Scand. J. Statist. 6:65); None stays None.

    If all null hypotheses hold, the probability that any corrected value is below α is at most α.
    """
    known = sorted((p, k) for k, p in enumerate(p_values) if p is not None)
    corrected, highest = list[float | None](p_values), 0.0
    for rank, (p, k) in enumerate(known):
        highest = max(highest, min(1.0, (len(known) - rank) * p))
        corrected[k] = highest
    return corrected
