"""Noise terms: one class a term, in one file each; nothing outside this package knows which there are."""

from allanjax.terms.base import NoiseTerm, Parameter, parameter
from allanjax.terms.bias_instability import BiasInstability
from allanjax.terms.bias_step import BiasStep
from allanjax.terms.drift_ramp import DriftRamp
from allanjax.terms.low_pass import LowPass
from allanjax.terms.markov import Markov
from allanjax.terms.power_law import PowerLaw
from allanjax.terms.quantization import Quantization
from allanjax.terms.random_walk import AngleRandomWalk, RateRandomWalk
from allanjax.terms.resonance import Resonance
from allanjax.terms.sinusoid import Sinusoid
from allanjax.terms.telegraph import Telegraph
from allanjax.terms.warm_up import WarmUp

__all__ = [
    "AngleRandomWalk",
    "BiasInstability",
    "BiasStep",
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
    "WarmUp",
    "parameter",
]
