"""allanjax: noise coefficients of inertial sensors from a static recording, with honest uncertainties.

import allanjax as aj

recording = aj.read("imu.csv", rate=100, gyro_unit="deg/s", accel_unit="g")
fit = aj.fit(recording)
print(fit)
fit.plot()
"""

import jax

# Allan variances of a long record span ten decades: single precision cannot hold them.
jax.config.update("jax_enable_x64", True)

from allanjax import critic  # noqa: E402
from allanjax.allan.deviation import AllanDeviation, allan_deviation  # noqa: E402
from allanjax.base.cache import enable_compilation_cache  # noqa: E402
from allanjax.base.errors import AllanjaxError, FitError, RecordingError, UnitError  # noqa: E402
from allanjax.critic import Cause, Critique, Finding  # noqa: E402
from allanjax.critic.critique import critique  # noqa: E402
from allanjax.estimate.as_json import to_dict  # noqa: E402
from allanjax.estimate.bulk import BulkFit, fit_many  # noqa: E402
from allanjax.estimate.fit import fit  # noqa: E402
from allanjax.estimate.loading import load  # noqa: E402
from allanjax.estimate.result import AxisFit, Fit  # noqa: E402
from allanjax.estimate.selection import AxisSelection, TermSelection, TermSet, basic_terms, select_terms  # noqa: E402
from allanjax.fleet.fleet import FleetResult, characterize_fleet  # noqa: E402
from allanjax.fleet.stream import AllanAccumulator, accumulate  # noqa: E402
from allanjax.inspection import Inspection, inspect  # noqa: E402
from allanjax.noise.estimate import Estimate  # noqa: E402
from allanjax.noise.model import Model  # noqa: E402
from allanjax.noise.sensors import SENSORS, SensorPreset  # noqa: E402
from allanjax.noise.simulate import simulate, simulate_recording  # noqa: E402
from allanjax.noise.terms import (  # noqa: E402
    AngleRandomWalk,
    BiasInstability,
    BiasStep,
    DriftRamp,
    LowPass,
    Markov,
    NoiseTerm,
    PowerLaw,
    Quantization,
    RateRandomWalk,
    Resonance,
    Sinusoid,
    Telegraph,
    WarmUp,
    parameter,
)
from allanjax.posterior.priors import LogNormal, LogUniform, ModifiedLogUniform, Uniform  # noqa: E402
from allanjax.posterior.result import AxisPosterior, Posterior, PosteriorWarning  # noqa: E402
from allanjax.posterior.sample import sample  # noqa: E402
from allanjax.record.io import ChunkedRecording, read, read_chunks, write  # noqa: E402
from allanjax.record.recording import Axis, Recording  # noqa: E402
from allanjax.record.units import convert  # noqa: E402
from allanjax.report.allan_figure import plot_allan  # noqa: E402
from allanjax.report.files import write_coefficients_csv, write_curve_csv, write_json  # noqa: E402
from allanjax.report.spectrum_figure import plot_psd  # noqa: E402
from allanjax.spectrum.psd import PowerSpectrum, power_spectrum  # noqa: E402

#: A fit's estimates are its coefficients.
Coefficient = Estimate


def __getattr__(name: str) -> str:
    """`allanjax.__version__`, which takes a while to find."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version(__name__)


__all__ = [
    "SENSORS",
    "AllanAccumulator",
    "AllanDeviation",
    "AllanjaxError",
    "AngleRandomWalk",
    "Axis",
    "AxisFit",
    "AxisPosterior",
    "AxisSelection",
    "BiasInstability",
    "BiasStep",
    "BulkFit",
    "Cause",
    "ChunkedRecording",
    "Coefficient",
    "Critique",
    "DriftRamp",
    "Estimate",
    "Finding",
    "Fit",
    "FitError",
    "FleetResult",
    "Inspection",
    "LogNormal",
    "LogUniform",
    "LowPass",
    "Markov",
    "Model",
    "ModifiedLogUniform",
    "NoiseTerm",
    "Posterior",
    "PosteriorWarning",
    "PowerLaw",
    "PowerSpectrum",
    "Quantization",
    "RateRandomWalk",
    "Recording",
    "RecordingError",
    "Resonance",
    "SensorPreset",
    "Sinusoid",
    "Telegraph",
    "TermSelection",
    "TermSet",
    "Uniform",
    "UnitError",
    "WarmUp",
    "accumulate",
    "allan_deviation",
    "basic_terms",
    "characterize_fleet",
    "convert",
    "critic",
    "critique",
    "enable_compilation_cache",
    "fit",
    "fit_many",
    "inspect",
    "load",
    "parameter",
    "plot_allan",
    "plot_psd",
    "power_spectrum",
    "read",
    "read_chunks",
    "sample",
    "select_terms",
    "simulate",
    "simulate_recording",
    "to_dict",
    "write",
    "write_coefficients_csv",
    "write_curve_csv",
    "write_json",
]
