"""Every noise term and every response with unequal parameters, for tests of what all of them must hold."""

import math
from collections.abc import Callable
from typing import Any

import jax

import allanjax as aj

#: Sample rate [Hz], no round number of anything below.
RATE = 40.0

#: Random terms. Beside each law its limits: flicker cut off below and above half the rate, power laws about
#: flicker and at both ends, processes far shorter and longer than a sample, an oscillator near critical.
RANDOM: dict[str, aj.NoiseTerm] = {
    "quantization": aj.Quantization(2.3e-6), "white": aj.AngleRandomWalk(1.7e-4),
    "flicker": aj.BiasInstability(4.1e-5), "flicker to 0.9 Hz": aj.BiasInstability(4.1e-5, 0.9),
    "flicker to 70 Hz": aj.BiasInstability(4.1e-5, 70.0), "walk": aj.RateRandomWalk(6.2e-6),
    "markov": aj.Markov(5.2e-5, 8.0), "short markov": aj.Markov(4.2e-3, 3e-3),
    "long markov": aj.Markov(2.2e-6, 9e3), "resonance": aj.Resonance(2.9e-4, 5.3, 12.0),
    "damped resonance": aj.Resonance(2.1e-4, 0.7, 0.6),
    "wandering resonance": aj.WanderingResonance(1.3e-4, 7.0, 9.0, 0.3),
    "power law -0.5": aj.PowerLaw(1.1e-4, -0.5), "power law 0.6": aj.PowerLaw(3.1e-4, 0.6),
    "power law 1.04": aj.PowerLaw(3.1e-5, 1.04), "power law 2.6": aj.PowerLaw(3.1e-6, 2.6),
    "low pass": aj.LowPass(1.9e-4, 2.2), "low pass of order 2": aj.LowPass(2.7e-4, 3.1, order=2),
    "telegraph": aj.Telegraph(4.3e-4, 0.3),
}  # fmt: skip
#: The same in every record, but for sign and phase.
DETERMINISTIC: dict[str, aj.NoiseTerm] = {"ramp": aj.DriftRamp(3.3e-5), "line": aj.Sinusoid(7.7e-4, 3.7112)}
#: What happens once.
TRANSIENT: dict[str, aj.NoiseTerm] = {
    "step": aj.BiasStep(4.3e-4, 2.0), "warm-up": aj.WarmUp(6.1e-4, 1.3),
    "effect": aj.ChannelEffect(2e-5, lag=0.1, channel="temperature"),
}  # fmt: skip
TERMS = RANDOM | DETERMINISTIC

#: Filters; a Butterworth filter with a pole at zero, a mean of a broken number of samples.
RESPONSES: dict[str, aj.Response] = {
    "one pole": aj.LowPass1(4.0), "two poles": aj.LowPass2(5.0, 2.3), "butterworth 1": aj.Butterworth(7.0, 1),
    "butterworth 2": aj.Butterworth(6.0, 2), "butterworth 3": aj.Butterworth(10.0, 3),
    "butterworth 8": aj.Butterworth(13.0, 8), "biquad": aj.Biquad(3.7, 0.577),
    "mean of 5": aj.MovingAverage.of(5.0 / RATE), "mean of 3.7": aj.MovingAverage.of(3.7 / RATE),
    "four means of 2.3": aj.MovingAverage.of(2.3 / RATE, 4),
}  # fmt: skip

#: Terms and filters that are others' formulas at other values, which one compiled program takes as data.
OTHER_VALUES = {
    "flicker to 70 Hz": "flicker to 0.9 Hz", "short markov": "markov", "damped resonance": "resonance",
    **{name: "power law 0.6" for name in RANDOM if name.startswith("power law") and name != "power law 0.6"},
    "mean of 5": "mean of 3.7",
}  # fmt: skip


def finite(model: aj.Model) -> dict[str, float]:
    """Values that a fit may change."""
    return {name: float(x) for name, x in model.values.items() if math.isfinite(x)}


def by_slots(program: Callable[[dict[str, Any]], Any], given: dict[str, Any]) -> dict[str, Any]:
    """Results by name of a program of one slot a formula, in as many runs as reach the data of all names."""
    found, left = {}, list(given)
    slots = {name: name for name in left if name not in OTHER_VALUES}
    while left:
        of_slot = slots | {OTHER_VALUES.get(name, name): name for name in reversed(left)}
        results = jax.device_get(program({slot: given[name] for slot, name in of_slot.items()}))
        found |= {name: results[slot] for slot, name in of_slot.items()}
        left = [name for name in left if name not in found]
    return found
