"""Noise terms: one class a term, in one file each; nothing outside this package knows which there are."""

from allanjax.terms.base import NoiseTerm, Parameter, parameter
from allanjax.terms.bias_instability import BiasInstability
from allanjax.terms.drift_ramp import DriftRamp
from allanjax.terms.markov import Markov
from allanjax.terms.quantization import Quantization
from allanjax.terms.random_walk import AngleRandomWalk, RateRandomWalk
from allanjax.terms.resonance import Resonance
from allanjax.terms.sinusoid import Sinusoid

__all__ = [
    "AngleRandomWalk",
    "BiasInstability",
    "DriftRamp",
    "Markov",
    "NoiseTerm",
    "Parameter",
    "Quantization",
    "RateRandomWalk",
    "Resonance",
    "Sinusoid",
    "parameter",
]
