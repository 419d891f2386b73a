"""Sampling of the posteriors of a fit's axes: parameters, priors, walkers, and the results from the draws."""

from __future__ import annotations

import dataclasses
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from jaxtyping import Int

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.result import Fit
from allanjax.posterior.likelihood import Likelihood, likelihood_of
from allanjax.posterior.marginals import absent_marginal, sampled_marginals, undetermined
from allanjax.posterior.priors import Prior, default_priors
from allanjax.posterior.result import AxisPosterior, PosteriorWarning
from allanjax.posterior.sampling import Chains, Convergence, LogPosterior, Target, first_walkers, run
from allanjax.posterior.unsampled_limits import absent_amplitude
from allanjax.posterior.wider import WiderLikelihood

# Default number of walkers, or four a parameter if that is more.
_WALKERS = 32


@dataclasses.dataclass(frozen=True)
class AxisSampler:
    """Sampler of a fit's axes, with the checked arguments of `sample`."""

    fit: Fit
    priors: Mapping[str, Prior]
    seed: int
    walkers: int | None
    convergence: Convergence
    absent_draws: int

    def __post_init__(self) -> None:
        if not self.absent_draws >= 2:
            raise AllanjaxError(f"absent_draws must be at least 2, got {self.absent_draws!r}")
        if not (isinstance(self.seed, int | np.integer) and self.seed >= 0):
            raise AllanjaxError(f"seed must be an integer of at least 0, got {self.seed!r}")

    def all_axes(self, names: Sequence[str], progress: bool | None) -> tuple[AxisPosterior, ...]:
        """Posteriors of the named axes, with a progress bar if wanted."""
        results = []
        with _progress_bar(progress) as bar:
            for name in names:
                task = None if bar is None else bar.add_task(name, total=None)

                def report(steps: int, expected: int, task: Any = task) -> None:
                    if bar is not None:
                        bar.update(task, completed=steps, total=expected)

                results.append(self.one_axis(name, report))
        return tuple(results)

    def one_axis(self, name: str, report: Callable[[int, int], None]) -> AxisPosterior:
        """Posterior of one axis; `report` is told the steps done and expected."""
        return dataclasses.replace(self, fit=self.fit.as_for(name))._one_axis(name, report)

    def _one_axis(self, name: str, report: Callable[[int, int], None]) -> AxisPosterior:
        """Posterior of an axis whose model is the fit's."""
        likelihood, widening = likelihood_of(self.fit, name), self.fit[name].widening
        if widening != 1.0:
            likelihood = WiderLikelihood.of(likelihood, widening)
        posterior = LogPosterior.of(likelihood, self._all_priors(likelihood))
        sampled = self._sampled(likelihood, name)
        walkers = self._walkers(len(sampled))
        target = Target.of(posterior, sampled, walkers // 2)
        # Each axis has random numbers of its own, so that its draws do not depend on the other axes.
        streams = np.random.SeedSequence([self.seed, self.fit.axes.index(name)]).generate_state(8)
        random = np.random.RandomState(streams)
        try:
            start = first_walkers(target, walkers, random)
        except FitError as error:
            raise FitError(f"{name}: {error}") from None
        chains = run(target, start, random, self.convergence, report)
        if not chains.converged:
            warnings.warn(self._complaint(name, likelihood, sampled, chains), PosteriorWarning, stacklevel=4)
        return self._result(name, target, chains, random)

    def _all_priors(self, likelihood: Likelihood) -> dict[str, Prior]:
        """Default priors, replaced by those of the user."""
        priors = default_priors(likelihood)
        for label, prior in self.priors.items():
            if label not in priors:
                raise AllanjaxError(
                    f"a prior for {label!r}, but there is no such parameter; there are {', '.join(priors)}"
                )
            if not isinstance(prior, Prior):
                raise AllanjaxError(
                    f"the prior of {label} must be a Prior, e.g. LogUniform(1e-6, 1e-4); got {prior!r}"
                )
        return priors | dict(self.priors)

    def _sampled(self, likelihood: Likelihood, name: str) -> Int[np.ndarray, " sampled"]:
        """Indices of the parameters to sample."""
        sampled = np.flatnonzero(likelihood.found | (not self.fit.chosen))
        if not sampled.size:
            raise FitError(f"{name}: no posterior, the fit found no term and no free parameter")
        return sampled

    def _walkers(self, count: int) -> int:
        """Number of walkers for `count` parameters."""
        if self.walkers is None:
            return max(_WALKERS, 4 * count)
        if self.walkers % 2 or self.walkers < 2 * max(count, 2):
            raise AllanjaxError(
                f"walkers must be an even number of at least {2 * max(count, 2)} for {count} parameters, "
                f"got {self.walkers!r}"
            )
        return self.walkers

    def _complaint(
        self, name: str, likelihood: Likelihood, sampled: Int[np.ndarray, " sampled"], chains: Chains
    ) -> str:
        """Warning about chains that have not converged: the worst parameter, and the remedy."""
        wanted = self.convergence
        length = wanted.min_length * chains.tau
        excess = (chains.r_hat - 1.0) / (wanted.max_r_hat - 1.0)
        lack = np.max([length / len(chains.y), excess, chains.change / wanted.max_change], axis=0)
        lack = np.nan_to_num(lack, nan=np.inf)
        worst = int(np.argmax(lack))
        label = likelihood.parameters[sampled[worst]].label
        return (
            f"{name}: the posterior has not converged in {chains.steps} steps; worst is {label} with τ = "
            f"{chains.tau[worst]:.3g} steps ({len(chains.y)} after the burn-in, "
            f"{length[worst]:.0f} wanted; τ last changed by "
            f"{100.0 * chains.change[worst]:.2g} %) and R̂ = {chains.r_hat[worst]:.4f}; "
            f"allow more steps, e.g. max_steps={4 * wanted.max_steps}, or give narrower priors"
        )

    def _result(
        self, name: str, target: Target, chains: Chains, random: np.random.RandomState
    ) -> AxisPosterior:
        """Posterior of one axis from its chains, with the marginals of parameters that were not sampled."""
        posterior, sampled = target.posterior, target.sampled
        fit, parameters = self.fit[name], posterior.likelihood.parameters
        full = target.embedded(chains.y)
        chain = posterior.values(full)[..., sampled]
        # The density per SI unit, instead of per unit of the coordinates.
        jacobian = posterior.log_jacobian(full)[..., sampled].sum(axis=-1)
        thin = max(1, int(np.nan_to_num(chains.tau).max() / 2.0))
        y = chains.y[::thin].reshape(-1, len(sampled))
        draws = chain[::thin].reshape(-1, len(sampled))

        known = sampled_marginals(posterior, fit.axis, sampled.tolist(), draws)
        for i, p in enumerate(parameters):
            if i in known:
                continue
            if posterior.amplitude[i]:
                grid = absent_amplitude(target, i, y, self.absent_draws, random)
                known[i] = absent_marginal(p, fit.axis, grid)
            else:
                known[i] = undetermined(p, fit.axis)
        marginals = {parameters[i].label: m for i, m in known.items()}
        for c in fit.coefficients.values():
            if c.held:
                marginals[c.label] = dataclasses.replace(c, source="posterior", sampled=False)
            elif c.rivals:
                # Draws are of the chosen terms only.
                marginals[c.label] = dataclasses.replace(marginals[c.label], detected=False, rivals=c.rivals)
        in_order = [p.label for p in self.fit.template.parameters if p.label in marginals]
        curve = self.fit.curve
        return AxisPosterior(
            axis=fit.axis,
            labels=tuple(parameters[i].label for i in sampled),
            draws=draws,
            chain=chain,
            log_probability=chains.log_density - jacobian,
            coefficients={label: marginals[label] for label in in_order},
            priors=dict(zip((p.label for p in parameters), posterior.priors, strict=True)),
            converged=chains.converged,
            tau=chains.tau,
            r_hat=chains.r_hat,
            acceptance=chains.acceptance,
            steps=chains.steps,
            rate=curve.rate,
            duration=curve.n / curve.rate,
            _template=self.fit.template,
        )


def _progress_bar(wanted: bool | None) -> AbstractContextManager[Any]:
    """Context of a progress bar on stderr, or of None if none is wanted."""
    if not (sys.stderr.isatty() if wanted is None else wanted):
        return nullcontext()
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("steps"),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))
