"""All that a critique assumes: prior odds of effects, and the limits that decide what is reported.

`PRIORS` has the prior odds and the share of each effect. `JUDGEMENTS` has all other limits that decide what
is reported. Both give their reasons. Other constants of the critic are numerical: grids, resolutions, numbers
of draws and rounds, thresholds of a closer search. Measured values come from the studies `critic` and
`unknown` (benchmarks/studies); their reports use other seeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from allanjax.critic.noise import FIXED, MARKOV, RAMP

#: Probability of a false finding in a record of one axis for which the prior odds are made.
FALSE_ALARMS = 0.01
#: Share of the axis's false alarms of each of fifteen kinds of test.
EQUAL = 1.0 / 15.0


class Prior(NamedTuple):
    """Assumptions about an effect.

    Attributes:
        log_odds: log prior odds for it [nats], including those that acceptance requires at `FALSE_ALARMS`.
        share: share of an axis's false alarms allowed to its p-value; None if its odds are the test.
        provenance: origin of the two: derived, cited, measured (how, on which records) or judged.
    """

    log_odds: float
    share: float | None
    provenance: str


_TWENTY = Prior(-3.0, EQUAL, "judgement: twenty to one against an effect")
_OF_SAMPLES = Prior(0.0, EQUAL, "its probability follows from the samples, beyond any threshold")

#: Name of the prior of what is at a place known from another axis.
SHARED = "shared"
#: Prior odds and shares by the name of the effect.
PRIORS: Mapping[str, Prior] = {
    **dict.fromkeys(
        (*FIXED, MARKOV, RAMP),
        Prior(
            -1.5,
            None,
            "measured: a further term (of 2,029 tried) gained so much in seven of 600 hidden-effects "
            "records with a complete model",
        ),
    ),
    "bias_step": Prior(
        -2.0,
        1.0,
        "measured: of 50 records without an effect by the generator of unknown effects, two have a step with "
        "odds of 1.1 and 2.4 nats; its p-value may use all false alarms, since the odds are the test",
    ),
    "power_law": Prior(
        -float(np.log(100.0)),
        None,
        "measured: none of 600 hidden-effects records without one gains more than two nats; the odds "
        "are a hundred to one",
    ),
    "telegraph": Prior(
        -3.0,
        None,
        "measured: none of 600 hidden-effects records without an effect has these odds and a gain on "
        "held-out data",
    ),
    "warm_up": Prior(-1.0, EQUAL, "judgement: sensors often warm up"),
    "temperature": Prior(-1.5, EQUAL, "judgement: sensors often depend on temperature"),
    "disturbance": Prior(-12.0, EQUAL, "judgement: many other effects are large"),
    "slow_change": Prior(-5.0, EQUAL, "judgement: known causes come first"),
    **dict.fromkeys(("outliers", "sinusoid", "spectral_shape", "variance_change"), _TWENTY),
    **dict.fromkeys(("rounding", "saturation", "repeated_samples"), _OF_SAMPLES),
    SHARED: Prior(-3.0, EQUAL, "judgement: vibration and knocks act on several axes, but not on all"),
    "common_mode": Prior(0.0, EQUAL, "derived: the distribution of a correlation is known"),
}
#: Prior of all user-defined effects together, which share it equally.
OWN = Prior(-3.0, EQUAL, "judgement: as for any other effect; the share is reserved for effects of users")


#: Limits in decisions by the effect or the step of the critique and their name, each with its reason.
JUDGEMENTS: Mapping[str, tuple[float, str]] = {
    "bias_step.apart": (0.02, "share of the record: steps farther apart are two, whatever their errors"),
    "bias_step.at once": (0.001, "share of the record within which steps of two axes are simultaneous"),
    "bias_step.clearly": (8.0, "nats more that a slower or decaying change, of seventy, must explain"),
    "common_mode.least": (64, "fewest independent coefficients for a correlation"),
    "common_mode.weakest": (0.2, "share of the strongest correlation; weaker ones belong to other groups"),
    "disturbance.longest": (0.25, "share of the record: in a longer one the sensor was not at rest"),
    "disturbance.loud": (2.0, "least ratio of the power in some band to that of the noise"),
    "disturbance.quiet": (3.0, "excess of a block's mean square [standard deviations] from which it is loud"),
    "disturbance.shortest": (0.1, "seconds: shorter ones are outliers"),
    "disturbance.smooth": (
        0.75,
        "least share of the excess power in the lowest quarter of the frequencies, since motion is smooth; "
        "hidden motions, 0.3 … 5 Hz at rates of 50 Hz and more, have a larger share",
    ),
    "event.alike": (0.9, "overlap, over the longer one, from which a stretch tells the event's ends"),
    "event.chance": (0.001, "expected number of chance coincidences above which outliers are not an event"),
    "event.few": (0.1, "share of outliers outside their event up to which they are not reported separately"),
    "event.nested": (0.2, "overlap, over the longer one, from which on two stretches of one axis are one"),
    "event.pause": (0.5, "seconds after which a new event begins"),
    "event.same": (0.7, "overlap, over the longer one, from which on stretches of several axes are one"),
    "event.short": (0.05, "share of the record up to which a change of variance is an event"),
    "level.small": (0.15, "change of the level [ln of an amplitude] below which all changes are one finding"),
    "line.beside": (0.25, "share of the fundamental within which its lines lie beside its multiples"),
    "line.near": (0.02, "share of the fundamental within which a harmonic is sought: few arise by chance"),
    "line.orders": (20, "highest order of a harmonic"),
    "line.quality": (50.0, "quality factor from which a resonance is a line, of a source outside the sensor"),
    "line.steady": (3.0, "resolved frequencies within which two lines are one that is not steady"),
    "low_pass.falls": (0.8, "largest ratio of the spectrum at half the rate to that in a pass band"),
    "low_pass.same": (0.1, "relative difference within which bandwidths are equal, as parts have tolerances"),
    "outliers.apart": (8, "samples within which prediction errors may have one cause"),
    "outliers.chance": (
        1e-5,
        "p-value of the gaps between outliers below which they are not independent; ten are compared, and "
        "none of 2,000 random sets had so small a one",
    ),
    "outliers.groups": (3, "groups of outliers up to which they may be knocks"),
    "outliers.longest": (48, "samples: a longer train of large errors is not an outlier"),
    "outliers.odds": (2.0, "log odds from which on a sample is an outlier: seven to one"),
    "power_law.distinct": (0.15, "least distance from basic exponents; hidden ones are half off or more"),
    "refit.level": (0.2, "change of the log level of the noise up to which a finding is not refitted"),
    "refit.lost": (2.5, "nats that refitting may cost, since a greedy search also explains some noise"),
    "refit.parameter": (0.3, "change of other findings [standard deviations] up to which it is not refitted"),
    "refit.sure": (20.0, "nats that must not be lost when a finding is dropped"),
    "repeated_samples.apart": (12, "samples beyond which equal values are from rounding: holds are shorter"),
    "repeated_samples.count": (3, "fewest repeats that are reported"),
    "repeated_samples.deviations": (8.0, "excess over repeats by rounding, in std"),
    "repeated_samples.share": (0.03, "error of the predicted share of repeats by rounding"),
    "resonance.broad": (20.0, "quality factor below which many resonances are another shape of the spectrum"),
    "resonance.most": (3, "broad resonances of one axis: hidden sensors have at most two"),
    "resonance.periods": (30.0, "fewest periods in the record: below, a peak may be that of a single event"),
    "resonance.quality": (3.0, "quality factor below which a peak is too broad; hidden ones have 5 and more"),
    "resonance.same": (4.0, "factor within which quality factors are the same: axes are damped differently"),
    "rounding.harmless": (0.35, "resolution over the deviation that does no harm; hidden steps are larger"),
    "saturation.share": (0.9, "share of clipped samples above which the others are unknown"),
    "search.certain": (1e-06, "largest p-value of a rejected candidate that is reported as undecided"),
    "search.clearly": (10.0, "nats by which the best candidate ends a round; reported rivals are within 7"),
    "search.imputed": (0.5, "share of imputed samples from which on nothing more is sought"),
    "search.most": (8, "findings in an axis: real units have up to eight"),
    "search.rivals": (1000.0, "largest odds against a rival that is reported"),
    "search.shortest": (1024, "fewest samples of a critique, so that halves have octaves to compare"),
    "search.worse": (4.0, "factor by which a finding may raise the excess of a model's Allan variance"),
    "sinusoid.periods": (6.0, "fewer periods in a record cannot be distinguished from drift"),
    "spectral_shape.left": (0.0001, "p-value of the rest of a spectrum below which it is searched again"),
    "telegraph.clearly": (
        4.0,
        "nats by which levels that decay must explain more than levels that stay, of forty compared; −3 at "
        "most for 24 hidden telegraphs, 2 to 280 for 13 hidden series of shocks that decay",
    ),
    "telegraph.jumps": (3, "one or two jumps are steps; hidden telegraphs have three or more"),
    "telegraph.regular": (0.005, "p-value of too even times between jumps: one true telegraph in 200"),
    "telling.nats": (100.0, "gain from which a finding has its own row; smaller ones rarely recur in halves"),
    "telling.share": (
        0.02,
        "share of the Allan variance from which it matters: a judgement, about N's error",
    ),
    "temperature.clock": (1e-6, "share of variance about a line below which a channel is a clock or counter"),
    "unexplained.left": (0.1, "share of a free description's gain that a finding may leave at its place"),
    "unexplained.nats": (10.0, "gain of a free description below which nothing is left"),
    "unexplained.p_value": (1e-6, "p-value below which one is reported: some fourteen tests per axis"),
    "variance_change.clearly": (3.0, "nats more that a wave must explain than a change of the level"),
    "variance_change.lasting": (0.5, "probability that it lasts to the record's end: half of hidden ones do"),
    "variance_change.more": (0.03, "share of the gain beyond two from which it varies in another way"),
    "variance_change.price": (3.0, "log Occam factor of the ratio [nats]: twenty values"),
    "variance_change.shortest": (0.01, "share of the record; a shorter change is an event"),
    "warm_up.clearly": (
        3.0,
        "nats by which a slope that begins or ends must explain more than settling, of 48 compared; 1 at "
        "most for 23 hidden warm-ups, 1 to 16 for eight hidden slopes",
    ),
    "warm_up.same": (2.0, "factor within which time constants of two axes are the same"),
}


def judged(cause: str, name: str) -> float:
    """Value of a judgement; counts of samples and the like are integers."""
    return JUDGEMENTS[f"{cause}.{name}"][0]
