"""Noise terms; only this package lists them.

Allan variances by equation of Hou (2004), and units of the parameters for gyros and accelerometers:

    Quantization         Q          3Q²/T² (4.29)                     arcsec            m/s
    AngleRandomWalk      N          N²/T (4.36)                       deg/√h            m/s/√h
    BiasInstability      B, f0      (4.48), tends to (2 ln2/π) B²     deg/h, Hz         µg, Hz
    RateRandomWalk       K          K²T/3 (4.53)                      deg/h/√h          m/s/h/√h
    DriftRamp            R          R²T²/2 (4.56)                     deg/h²            m/s/h²
    Markov               q_c, T_c   (4.60)                            deg/h/√h, s       m/s/h/√h, s
    Sinusoid             Ω0, f0     (4.64)                            deg/h, Hz         µg, Hz
    Resonance            σ, f0, Q_f damped oscillator                 deg/h, Hz         µg, Hz
    WanderingResonance   … and Δf   the same, f0 spread by Δf         deg/h, Hz         µg, Hz
    LowPass              N_f, f_c   PSD N²/(1 + (f/f_c)^(2·order))    deg/√h, Hz        m/s/√h, Hz
    PowerLaw             A, α       PSD A²·(f/1 Hz)^(−α)              deg/√h            m/s/√h
    Telegraph            J, T_d     jumps between two levels          deg/h, s          µg, s
    BiasStep, WarmUp     Δ, t_s; W, τ  deterministic; W·e^(−t/τ)      deg/h, s          µg, s
    ChannelEffect        c, t_l     deterministic, c·channel(t − t_l) deg/h, s          µg, s

N is the root of the two-sided PSD.
"""

import functools

from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.parameter import Parameter, parameter
from allanjax.noise.terms.deterministic import BiasStep, ChannelEffect, DriftRamp, Sinusoid, WarmUp
from allanjax.noise.terms.random import (
    AngleRandomWalk,
    BiasInstability,
    LowPass,
    Markov,
    PowerLaw,
    Quantization,
    RateRandomWalk,
    Resonance,
    Telegraph,
    WanderingResonance,
)


@functools.cache
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
