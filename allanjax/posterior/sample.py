"""Sampling the posterior of a fit."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import Progress, TaskID

from allanjax.base.errors import AllanjaxError, FitError, expect
from allanjax.estimate.result import Fit
from allanjax.posterior.priors import Prior
from allanjax.posterior.result import Posterior


def sample(
    fit: Fit,
    axes: Sequence[str] | str | None = None,
    *,
    priors: Mapping[str, Prior] | None = None,
    seed: int = 0,
    walkers: int | None = None,
    max_steps: int = 20_000,
    min_length: float = 50.0,
    max_change: float = 0.05,
    max_r_hat: float = 1.01,
    absent_draws: int = 256,
    progress: bool | None = None,
) -> Posterior:
    """Sample the posterior of a fit's coefficients with emcee's ensemble of walkers.

    The likelihood is that of the fit. If the fit chose its terms, the detected ones are sampled, and the
    amplitude of each of the others gets its marginal posterior by reweighting, one at a time. If the model
    was given, all its free parameters are sampled. Chains run until they are longer than `min_length`
    integrated autocorrelation times τ of every parameter (Goodman & Weare 2010, Comm. App. Math. Comp. Sci.
    5:65; without five τ of burn-in), no τ has changed by more than `max_change` since the last check, and the
    rank-normalized split R̂ over the walkers (Vehtari et al. 2021, Bayesian Analysis 16:667) is below
    `max_r_hat`.

    Default priors are `ModifiedLogUniform` for amplitudes, with the smallest amplitude that these data
    distinguish from zero as their scale, and `LogUniform` in the distance from the lower bound for times,
    frequencies and numbers. Supports are far wider than needed.

    Args:
        fit: a result of `allanjax.fit`.
        axes: names of the axes to sample; all by default.
        priors: priors by label, in SI, that replace the default ones in every axis, e.g.
            `{"rate_random_walk": LogUniform(1e-6, 1e-4)}`.
        seed: the same seed gives the same draws of an axis, independently of the other axes.
        walkers: an even number, at least twice the number of sampled parameters; by default 32, or four per
            parameter if that is more.
        max_steps: maximum number of steps of every walker, including the burn-in, after a warm-up of at most
            100 steps in which the proposals adapt.
        min_length: minimum length of the chain in τ.
        max_change: maximum relative change of τ.
        max_r_hat: maximum of R̂.
        absent_draws: number of draws for the posterior of a term that was not sampled; 256 give its upper
            limit to about 1 %.
        progress: whether to show a progress bar on stderr; by default only in a terminal.

    Returns:
        The posterior. Chains that have not converged after `max_steps` are marked and cause a
        `PosteriorWarning`.

    Raises:
        AllanjaxError: an unknown axis or label, or an invalid number.
        FitError: the fit of an axis failed, or the posterior has no density anywhere.
    """
    expect(fit, Fit, "sample takes a fit, as allanjax.fit returns")
    # Imported here because emcee takes long to load.
    from allanjax.posterior.sampling import Options, posterior_of

    names = (axes,) if isinstance(axes, str) else tuple(fit.axes if axes is None else axes)
    if not names:
        raise AllanjaxError(f"name at least one axis to sample, of {', '.join(fit.axes)}")
    for name in names:
        result = fit[name]
        if not fit.curve.determined:
            raise FitError(f"{name}: no posterior, as there are {fit.curve.unknown[0]}")
        if not (result.converged and result.measured):
            looked = f"{result.verdict}; allanjax.critique looks for the cause"
            why = looked if result.converged else f"the fit failed ({result.reason})"
            raise FitError(f"{name}: no posterior: {why}; sample the others with axes=[…]")
    options = Options(seed, walkers, max_steps, min_length, max_change, max_r_hat, absent_draws)
    shown, results = sys.stderr.isatty() if progress is None else progress, []
    with Progress(console=Console(stderr=True), disable=not shown) as bar:
        for name in names:
            task = bar.add_task(name, total=None)

            def report(steps: int, expected: int, task: TaskID = task) -> None:
                bar.update(task, completed=steps, total=expected)

            results.append(posterior_of(fit.as_for(name), name, dict(priors or {}), options, report))
    return Posterior(fit, tuple(results))
