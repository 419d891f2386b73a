"""Noise terms, one class in one file each; only this package lists them."""

from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.parameter import Parameter, parameter
from allanjax.noise.terms.bias_instability import BiasInstability
from allanjax.noise.terms.bias_step import BiasStep
from allanjax.noise.terms.channel_effect import ChannelEffect
from allanjax.noise.terms.drift_ramp import DriftRamp
from allanjax.noise.terms.low_pass import LowPass
from allanjax.noise.terms.markov import Markov
from allanjax.noise.terms.power_law import PowerLaw
from allanjax.noise.terms.quantization import Quantization
from allanjax.noise.terms.random_walk import AngleRandomWalk, RateRandomWalk
from allanjax.noise.terms.resonance import Resonance
from allanjax.noise.terms.sinusoid import Sinusoid
from allanjax.noise.terms.telegraph import Telegraph
from allanjax.noise.terms.wandering_resonance import WanderingResonance
from allanjax.noise.terms.warm_up import WarmUp


def basic_terms() -> Model:
    """The thesis's five basic terms: quantization, random walk, bias instability, rate random walk, ramp."""
    return Quantization() + AngleRandomWalk() + BiasInstability() + RateRandomWalk() + DriftRamp()


__all__ = [
    "AngleRandomWalk",
    "BiasInstability",
    "BiasStep",
    "ChannelEffect",
    "DriftRamp",
    "LowPass",
    "Markov",
    "NoiseTerm",
    "Parameter",
    "PowerLaw",
    "Quantization",
    "RateRandomWalk",
    "Resonance",
    "Sinusoid",
    "Telegraph",
    "WanderingResonance",
    "WarmUp",
    "basic_terms",
    "parameter",
]
