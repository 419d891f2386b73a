"""Every cause: named, alone, measured as well as anybody could, and worth what other data say.

Each effect is four times as strong as what can be detected, in an axis of its own; `test_clean` has them at a
third of the limit. `critic_records` has the truth and the bounds, which are computed without allanjax.
"""

import critic_records as cr
import numpy as np
import pytest
from critic_records import KNOWN, critique, hidden_in
from scipy.fft import idct
from scipy.stats import norm

from allanjax.critic import CAUSES

DEG = np.pi / 180.0
#: SI values of the units of basic terms.
SI = {
    "arcsec": DEG / 3600.0,
    "deg/√h": DEG / 60.0,
    "deg/h": DEG / 3600.0,
    "deg/h/√h": DEG / 216_000.0,
    "deg/h²": DEG / 3600.0**2,
    "s": 1.0,
}
#: Coefficients in time have dimensions, parameters of shape these.
UNITS = dict.fromkeys(("time", "start", "end", "lag", "time_constant", "dwell_time"), "s")
UNITS |= dict.fromkeys(("frequency", "bandwidth"), "Hz") | {"longest": "samples"}
UNITS |= dict.fromkeys(
    ("quality_factor", "ratio", "exponent", "order", "count", "jumps", "fraction", "correlation"), "1"
)
PER = {"temperature": "/[temperature]", "power_law": "/√Hz"}
#: Positive parameters that are known by their logarithm: their error grows with the estimate.
LOGARITHMIC = {
    *(("warm_up", "time_constant"), ("telegraph", "dwell_time"), ("outliers", "scale")),
    *(("low_pass", "bandwidth"), ("resonance", "quality_factor"), ("resonance", "frequency")),
    ("markov", "correlation_time"),
}
#: Least and largest deviation over the bound where it is not within 25 %, and why.
HONEST = {
    # Lags and places are compared on a grid whose spacing over √12 is in the error.
    ("temperature", "lag"): (0.75, 1.5),
    ("bias_step", "time"): (0.75, 1.6),
    # The law of an end is that of the highest place of a random walk, no normal one: its width varies from
    # record to record, and the critic's is the mean one with the spacing of its blocks.
    ("variance_change", "start"): (0.5, 2.0),
    ("variance_change", "end"): (0.5, 2.0),
    # The bound is that of all jumps; of those that are near each other some are not seen.
    ("telegraph", "dwell_time"): (0.75, 1.6),
    # Of twenty errors the curvature of the likelihood scatters.
    ("outliers", "scale"): (0.7, 1.4),
    # A filter near the Nyquist frequency is known no better than quantization noise beside it, and whether
    # there is any the record does not tell.
    ("low_pass", "bandwidth"): (0.75, 1.6),
}


SCENES = (*cr.SCENES, *KNOWN)
EFFECTS = [
    (name, axis, hidden.cause)
    for name in SCENES
    for axis, hidden in hidden_in(name, 4.0).items()
    if hidden.cause != "common_mode"
]


def measured(finding, label, truth, bound, scale):
    """Assert that a parameter is right, its deviation near the bound, and its intervals those of its law."""
    e = finding.parameters[label]
    value, std = e.value * scale, e.std * scale
    if not std > 1e-6 * abs(value):
        # Jumps that are near each other are not seen.
        assert value == pytest.approx(truth, rel=1e-9, abs=4.0 * (label == "jumps"))
        return
    assert abs(value - truth) < 4.0 * std, (label, value, truth, std)
    skewed = (finding.cause, label) in LOGARITHMIC
    for interval, width in ((e.interval, norm.ppf(0.975)), (e.interval_68, 1.0)):
        deviations = np.array(
            [np.log(end / e.value) * e.value if skewed else end - e.value for end in interval]
        )
        np.testing.assert_allclose(deviations / e.std, [-width, width], rtol=1e-4)
    if label in bound:
        least, most = HONEST.get((finding.cause, label), (0.75, 1.25))
        own = bound[label] * (value / truth if skewed else 1.0)
        assert least < std / own < most, (label, std, own)


@pytest.mark.parametrize(("name", "axis", "cause"), EFFECTS)
def test_an_effect_is_named_alone_and_measured_as_well_as_can_be(name, axis, cause):
    found, hidden = critique(name), hidden_in(name, 4.0)[axis]
    assert [f.cause for f in found[axis].findings] == [cause]
    (finding,) = found[axis].findings
    bound = hidden.bound(set(found.models[axis].term_labels) - hidden.terms - {cause})
    assert set(finding.parameters) == set(hidden.truth)
    for label, truth in hidden.truth.items():
        unit, scale = finding.parameters[label].unit, 1.0
        if name in KNOWN:
            scale = SI[unit]
        else:
            assert unit == UNITS.get(label, found[axis].axis.unit + PER.get(cause, ""))
        measured(finding, label, truth, bound, scale)


def test_noise_that_two_axes_share_is_named_and_measured():
    found, hidden = critique("samples"), cr.scene("samples", 4.0)["accel_y"]
    (shared,) = found.shared_findings
    assert (shared.cause, shared.axes) == ("common_mode", ("accel_y", "accel_z"))
    measured(shared, "correlation", hidden.truth["correlation"], hidden.bound(()), 1.0)
    assert found["accel_y"].findings == found["accel_z"].findings == ()
    ((pair),) = shared.details["pairs"]
    assert pair == f"accel_z/accel_y: {-shared.parameters['correlation'].value:+.3g}"
    r = hidden.truth["correlation"]
    # Gain of an axis given the other, −½·n·ln(1 − r²) ± √n·r.
    assert shared.gain == pytest.approx(-0.5 * cr.N * np.log1p(-(r**2)), abs=4.0 * np.sqrt(cr.N) * r)


def test_all_causes_are_looked_for_here():
    """A filter and resonances are one cause to look for and two to name."""
    named = {cause for *_, cause in EFFECTS} - {"low_pass", "resonance", "common_mode"}
    assert named | {"spectral_shape"} == {cause.name for cause in CAUSES}


# --- What a finding is worth --------------------------------------------------------------------------------


def worth(hidden, rate, terms=None):
    """Log-likelihood that the truth gains over the best basic terms on a record that it was not fitted to."""
    c = cr.coefficients(hidden.values)
    left = c if hidden.path is None else c - cr.coefficients(hidden.path)
    return cr.log_likelihood(left**2, hidden.expected) - cr.basic_likelihood(c, rate, terms)


def louder(hidden):
    """The same for independent samples whose variance is another one inside of an interval."""
    rate, truth = cr.SCENES["moments"][0], hidden.truth
    white = idct(np.r_[0.0, cr.coefficients(hidden.values) / np.sqrt(hidden.expected)], norm="ortho")
    inside = slice(round(truth["start"] * rate), round(truth["end"] * rate))
    squares, level = white**2, np.ones(cr.N)
    level[inside] = truth.get("ratio", squares[inside].mean() ** 0.5) ** 2
    # Motion is beside noise that is known; louder noise is part of what the level is known from.
    whole = squares.mean() if "ratio" in truth else 1.0
    return 0.5 * float(np.sum(squares / whole - squares / level + np.log(whole / level)))


def spotted(hidden):
    """The same for a share of errors of a larger scale."""
    white = hidden.values - np.median(hidden.values)
    z = white / hidden.noise[0]
    share, scale = 20.0 / cr.N, hidden.truth["scale"] / hidden.noise[0]
    wide = norm.logpdf(z, scale=np.hypot(1.0, scale)) - norm.logpdf(z)
    return float(np.sum(np.logaddexp(np.log1p(-share), np.log(share) + wide)))


#: Least and largest share of what the truth gains that findings tell, beside a few nats for each parameter.
SHARES = {
    # A path has to be seen from half of the samples, between which it jumps unseen.
    "telegraph": (0.2, 1.0),
    # One half of the coefficients foretells the other.
    "resonance": (0.85, 1.0),
    # Of which stretch it is, motion that fades leaves some freedom.
    "disturbance": (0.9, 1.1),
}


@pytest.mark.parametrize(
    ("name", "axis", "cause"), [row for row in EFFECTS if row[0] not in ("samples", "other", "white")]
)
def test_the_gain_on_held_out_data_is_that_of_the_truth(name, axis, cause):
    """It is what the effect gains on data that the truth was not fitted to: these, as their maker knows."""
    found, hidden = critique(name), cr.scene(name, 4.0)[axis]
    law = {"variance_change": louder, "disturbance": louder, "outliers": spotted}
    if cause in law:
        expected = law[cause](hidden)
    else:
        # What is in the spectrum's structure is told beside the other terms that are in it.
        terms = found.models[axis].term_labels if cause in ("low_pass", "resonance") else None
        expected = worth(hidden, cr.SCENES[name][0], terms)
    least, most = SHARES.get(cause, (0.97, 1.03))
    assert least * expected - 6.0 < found[axis].findings[0].gain < most * expected + 4.0
