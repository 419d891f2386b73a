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
_TWENTY = "judgement: twenty to one against an effect; the share is one of fifteen equal ones"


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


_OF_SAMPLES = (
    "its probability follows from the samples, beyond any threshold; the share is one of fifteen equal"
)

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
    "warm_up": Prior(-1.0, EQUAL, "judgement: sensors often warm up; the share is one of fifteen equal ones"),
    "temperature": Prior(
        -1.5, EQUAL, "judgement: sensors often depend on temperature; the share is one of fifteen equal ones"
    ),
    "disturbance": Prior(
        -12.0, EQUAL, "judgement: many other effects are large; the share is one of fifteen"
    ),
    "slow_change": Prior(
        -5.0, EQUAL, "judgement: known causes come first; the share is one of fifteen equal ones"
    ),
    "outliers": Prior(-3.0, EQUAL, _TWENTY),
    "sinusoid": Prior(-3.0, EQUAL, _TWENTY),
    "spectral_shape": Prior(-3.0, EQUAL, _TWENTY),
    "variance_change": Prior(-3.0, EQUAL, _TWENTY),
    "rounding": Prior(0.0, EQUAL, _OF_SAMPLES),
    "saturation": Prior(0.0, EQUAL, _OF_SAMPLES),
    "repeated_samples": Prior(0.0, EQUAL, _OF_SAMPLES),
    SHARED: Prior(
        -3.0,
        EQUAL,
        "judgement: vibration and knocks act on several axes, but not on all; the share is one of fifteen",
    ),
    "common_mode": Prior(
        0.0, EQUAL, "derived: the distribution of a correlation is known; one of fifteen equal shares"
    ),
}
#: Prior of all user-defined effects together, which share it equally.
OWN = Prior(-3.0, EQUAL, "judgement: as for any other effect; the share is reserved for effects of users")


class Judgement(NamedTuple):
    """Limit in a decision, and its reason."""

    value: float
    provenance: str


#: Limits by the effect or the step of the critique, and name.
JUDGEMENTS: Mapping[tuple[str, str], Judgement] = {
    ("bias_step", "apart"): Judgement(
        0.02, "share of the record beyond which steps of two axes are not simultaneous, whatever their errors"
    ),
    ("bias_step", "at once"): Judgement(
        0.001, "share of the record within which steps of two axes are simultaneous"
    ),
    ("bias_step", "clearly"): Judgement(
        8.0, "nats by which a slower or a decaying change must explain more than a step, of seventy compared"
    ),
    ("common_mode", "least"): Judgement(64, "fewest independent coefficients for a correlation"),
    ("common_mode", "weakest"): Judgement(
        0.2, "share of the strongest correlation below which another one belongs to another group"
    ),
    ("disturbance", "longest"): Judgement(
        0.25, "share of the record: in a longer one the sensor was not at rest"
    ),
    ("disturbance", "loud"): Judgement(2.0, "least ratio of the power in some band to that of the noise"),
    ("disturbance", "quiet"): Judgement(
        3.0, "excess of a block's mean square, in standard deviations, from which on it is loud"
    ),
    ("disturbance", "shortest"): Judgement(0.1, "seconds: shorter ones are outliers"),
    ("disturbance", "smooth"): Judgement(
        0.75,
        "least share of the excess power in the lowest quarter of the frequencies, since motion is smooth; "
        "hidden motions, 0.3 … 5 Hz at rates of 50 Hz and more, have a larger share",
    ),
    ("event", "alike"): Judgement(
        0.9, "overlap, over the longer one, from which on a stretch tells the event's start and end"
    ),
    ("event", "chance"): Judgement(
        0.001, "expected number of chance coincidences above which outliers are not an event"
    ),
    ("event", "few"): Judgement(
        0.1, "share of outliers outside their event up to which they are not reported separately"
    ),
    ("event", "nested"): Judgement(
        0.2, "overlap, over the longer one, from which on two stretches of one axis are one"
    ),
    ("event", "pause"): Judgement(0.5, "seconds after which a new event begins"),
    ("event", "same"): Judgement(
        0.7, "overlap, over the longer one, from which on stretches of several axes are one"
    ),
    ("event", "short"): Judgement(0.05, "share of the record up to which a change of variance is an event"),
    ("line", "beside"): Judgement(
        0.25, "share of the fundamental within which lines of one source lie beside its multiples"
    ),
    ("line", "near"): Judgement(
        0.02, "share of the fundamental within which a harmonic is sought, so that few arise by chance"
    ),
    ("line", "orders"): Judgement(20, "highest order of a harmonic"),
    ("line", "quality"): Judgement(
        50.0, "quality factor from which on a resonance is a line, of a source outside the sensor"
    ),
    ("line", "steady"): Judgement(
        3.0, "resolved frequencies within which two lines are one that is not steady"
    ),
    ("low_pass", "falls"): Judgement(
        0.8, "largest ratio of the spectrum at half the sample rate to that in the pass band of a filter"
    ),
    ("low_pass", "same"): Judgement(
        0.1, "relative difference within which bandwidths are equal: parts of filters have tolerances"
    ),
    ("outliers", "apart"): Judgement(8, "samples within which prediction errors may have one cause"),
    ("outliers", "chance"): Judgement(
        1e-5,
        "p-value of the gaps between outliers below which they are not independent; ten are compared, and "
        "none of 2,000 random sets had so small a one",
    ),
    ("outliers", "groups"): Judgement(3, "groups of outliers up to which they may be knocks"),
    ("outliers", "longest"): Judgement(48, "samples: a longer train of large errors is not an outlier"),
    ("outliers", "odds"): Judgement(2.0, "log odds from which on a sample is an outlier: seven to one"),
    ("power_law", "distinct"): Judgement(
        0.15, "least distance of the exponent from those of basic terms; hidden ones are half off or more"
    ),
    ("refit", "level"): Judgement(
        0.2, "change of the log level of the noise up to which a finding is not refitted"
    ),
    ("refit", "lost"): Judgement(
        2.5, "nats that refitting may cost, since a greedy search also explains some noise"
    ),
    ("refit", "parameter"): Judgement(
        0.3, "change of other findings, in standard deviations, up to which it is not refitted"
    ),
    ("refit", "sure"): Judgement(20.0, "nats that must not be lost when a finding is dropped"),
    ("repeated_samples", "apart"): Judgement(
        12, "samples: values are rarely held so long, so that samples so far apart are equal only by rounding"
    ),
    ("repeated_samples", "count"): Judgement(3, "fewest repeats that are reported"),
    ("repeated_samples", "deviations"): Judgement(8.0, "excess over repeats by rounding, in std"),
    ("repeated_samples", "share"): Judgement(0.03, "error of the predicted share of repeats by rounding"),
    ("resonance", "broad"): Judgement(
        20.0, "quality factor below which many resonances are rather another shape of the spectrum"
    ),
    ("resonance", "most"): Judgement(3, "broad resonances of one axis: hidden sensors have at most two"),
    ("resonance", "periods"): Judgement(
        30.0, "fewest periods in the record: below, a peak may be the spectrum of a single event"
    ),
    ("resonance", "quality"): Judgement(
        3.0, "quality factor below which a peak is too broad for a resonance; hidden ones have 5 and more"
    ),
    ("resonance", "same"): Judgement(
        4.0, "factor within which quality factors are the same: axes are damped differently"
    ),
    ("rounding", "harmless"): Judgement(
        0.35,
        "resolution over the noise's deviation below which rounding is harmless; hidden steps are larger",
    ),
    ("saturation", "share"): Judgement(0.9, "share of clipped samples above which the others are unknown"),
    ("search", "certain"): Judgement(
        1e-06, "largest p-value of a rejected candidate that is reported as undecided"
    ),
    ("search", "clearly"): Judgement(
        10.0, "nats by which the best candidate ends a round; reported rivals are within 7 nats"
    ),
    ("search", "imputed"): Judgement(0.5, "share of imputed samples from which on nothing more is sought"),
    ("search", "most"): Judgement(8, "findings in an axis: real units have up to eight"),
    ("search", "rivals"): Judgement(1000.0, "largest odds against a rival that is reported"),
    ("search", "shortest"): Judgement(
        1024, "fewest samples of a critique, so that halves have octaves to compare"
    ),
    ("sinusoid", "periods"): Judgement(6.0, "fewer periods in a record cannot be distinguished from drift"),
    ("spectral_shape", "left"): Judgement(
        0.0001, "p-value of the rest of a spectrum below which it is searched again"
    ),
    ("telegraph", "clearly"): Judgement(
        4.0,
        "nats by which levels that decay must explain more than levels that stay, of forty compared; −3 at "
        "most for 24 hidden telegraphs, 2 to 280 for 13 hidden series of shocks that decay",
    ),
    ("telegraph", "jumps"): Judgement(3, "one or two jumps are steps; hidden telegraphs have three or more"),
    ("telegraph", "regular"): Judgement(
        0.005, "p-value of times between jumps that scatter less than random ones: one true telegraph in 200"
    ),
    ("temperature", "clock"): Judgement(
        1e-6, "share of a channel's variance about a straight line below which it is a clock or a counter"
    ),
    ("unexplained", "left"): Judgement(
        0.1, "share of what a free description gains that a named finding may leave at its place"
    ),
    ("unexplained", "nats"): Judgement(10.0, "gain of a free description below which nothing is left"),
    ("unexplained", "p_value"): Judgement(
        1e-6, "p-value below which an unexplained discrepancy is reported: some fourteen tests per axis"
    ),
    ("variance_change", "clearly"): Judgement(
        3.0,
        "nats by which a wave of the level must explain more than a change from level to level",
    ),
    ("variance_change", "lasting"): Judgement(
        0.5, "prior probability that a change lasts to an end of the record, as half of the hidden ones do"
    ),
    ("variance_change", "more"): Judgement(
        0.03, "share of the gain beyond two changes from which the level varies in another way"
    ),
    ("variance_change", "price"): Judgement(3.0, "log Occam factor of the ratio [nats]: twenty values"),
    ("variance_change", "shortest"): Judgement(0.01, "share of the record; a shorter change is an event"),
    ("warm_up", "clearly"): Judgement(
        3.0,
        "nats by which a slope that begins or ends must explain more than settling, of 48 compared; 1 at "
        "most for 23 hidden warm-ups, 1 to 16 for eight hidden slopes",
    ),
    ("warm_up", "same"): Judgement(2.0, "factor within which time constants of two axes are the same"),
}


def judged(cause: str, name: str) -> float:
    """Value of a judgement; counts of samples and the like are integers."""
    return JUDGEMENTS[cause, name].value
