"""What each finding alone changes: the final model, and the record, without it, and the rest held.

Nothing is fitted again. A rest that is fitted again takes over what was left out, and changes in a way that
says little about the finding: without a filter at 39 Hz a rate random walk would be fourteen times as large.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from allanjax.allan.estimators import cluster_sizes
from allanjax.critic.finding import NOTABLE, Change
from allanjax.critic.noise import RAMP, NoiseFamily, spectrum_factor
from allanjax.critic.profiles import allan_weights
from allanjax.critic.stage import Stage, narrow_bins, octave_bins
from allanjax.critic.step import Step
from allanjax.estimate.spectral.model import Structure

# Cluster times per octave, the part of the record up to which they are compared, and the fewest coefficients
# of a band whose levels are.
_PER_OCTAVE, _LONGEST, _LEAST = 4, 4, 8


def without(step: Step, whole: Stage) -> Stage:
    """Last stage of an axis without one of its findings: with what it subtracts, or less what it adds."""
    path = step.path
    if path is not None:
        return dataclasses.replace(whole, x=whole.x + path)
    before, after = step.before.structure, step.candidate.after.structure
    if before is not after and before is not None and after is not None:
        ratio = _spectrum(before, whole.family) / _spectrum(after, whole.family)
        factor = ratio if whole.factor is None else whole.factor * ratio
        return dataclasses.replace(whole, factor=factor)
    cause = step.candidate.cause
    left = {name: power for name, power in whole.powers.items() if name != cause}
    return dataclasses.replace(whole, powers=left or whole.powers, ramp=0.0 if cause == RAMP else whole.ramp)


def _spectrum(structure: Structure, family: NoiseFamily) -> Float[np.ndarray, " n-1"]:
    """Expected squared coefficients of a structure [rate²]."""
    factor, slow = spectrum_factor(structure, family)
    return factor * slow


def change_of(whole: Stage, lacking: Stage, is_waveform: bool) -> Change:
    """What a finding changes, given the last stage of its axis and the same without the finding.

    A waveform does not depend on the noise; what else a finding subtracts may be a part of it.
    """
    n, rate = whole.n, whole.rate
    model = whole.sums[0]
    if whole.same_record(lacking):
        having, missing = model, lacking.sums[0]
    elif is_waveform:
        path = lacking.residual - whole.residual
        having, missing = model + np.add.reduceat(path**2, narrow_bins(n)[:-1] - 1), model
    else:
        having, missing = np.maximum(model + lacking.sums[2] - whole.sums[2], 0.0), model
    sizes = cluster_sizes(n, rate, _PER_OCTAVE)
    sizes = sizes[sizes <= max(n // _LONGEST, 1)]
    weights = allan_weights(n, tuple(sizes.tolist()))
    shares = _share(weights @ having, weights @ missing)
    edges = octave_bins(n)
    first = np.searchsorted(narrow_bins(n), edges[:-1])
    densities = _share(np.add.reduceat(having, first), np.add.reduceat(missing, first))
    densities = np.where(np.diff(edges) >= _LEAST, densities, 0.0)
    most, place = int(np.argmax(abs(shares))), int(np.argmax(abs(densities)))
    notable = sizes[abs(shares) >= NOTABLE] / rate
    return Change(
        share=float(shares[most]),
        time=float(sizes[most] / rate),
        first=float(notable[0]) if len(notable) else np.nan,
        last=float(notable[-1]) if len(notable) else np.nan,
        density=float(densities[place]),
        frequency=float((edges[place] + edges[place + 1] - 1) * rate / (4.0 * n)),
    )


def _share(having: Float[np.ndarray, " m"], missing: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Difference that a finding makes, as a share of the larger of what is with it and without it."""
    return (having - missing) / np.maximum(np.maximum(having, missing), 1e-300)
