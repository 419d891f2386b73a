"""Figure of a recording's Allan deviations at several sample rates."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from allanjax.base.errors import AllanjaxError
from allanjax.navigation.rates import SampleRates
from allanjax.report.allan_figure import plot_allan

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_sample_rates(
    result: SampleRates,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    how: Literal["picked", "averaged"] = "picked",
) -> Figure:
    """Draw the Allan deviations at each rate over one another, of samples picked or averaged."""
    if how not in ("picked", "averaged"):
        raise AllanjaxError(f'how is "picked" or "averaged", not {how!r}')
    curves = getattr(result, how)
    return plot_allan(curves, axes, path, labels=[f"{curve.rate:g} Hz, {how}" for curve in curves])
