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

from allanjax import critic
from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.base.cache import enable_compilation_cache
from allanjax.base.errors import AllanjaxError, FitError, RecordingError, UnitError
from allanjax.critic import Cause, Critique, Finding
from allanjax.critic.critique import critique
from allanjax.estimate.as_json import to_dict
from allanjax.estimate.bulk import BulkFit, fit_many
from allanjax.estimate.fit import fit
from allanjax.estimate.loading import load
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSelection, TermSet, select_terms
from allanjax.fleet.fleet import FleetResult, characterize_fleet
from allanjax.fleet.stream import AllanAccumulator, accumulate
from allanjax.inspection import Inspection, inspect
from allanjax.noise import terms
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.sensors import SENSORS, SensorPreset
from allanjax.noise.simulate import simulate, simulate_recording
from allanjax.noise.terms import *
from allanjax.posterior.priors import LogNormal, LogUniform, ModifiedLogUniform, Uniform
from allanjax.posterior.result import AxisPosterior, Posterior, PosteriorWarning
from allanjax.posterior.sample import sample
from allanjax.record.io import ChunkedRecording, read, read_chunks, write
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import convert
from allanjax.report.allan_figure import plot_allan
from allanjax.report.files import write_coefficients_csv, write_curve_csv, write_json
from allanjax.report.spectrum_figure import plot_psd
from allanjax.spectrum.psd import PowerSpectrum, power_spectrum

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
    "Axis",
    "AxisFit",
    "AxisPosterior",
    "AxisSelection",
    "BulkFit",
    "Cause",
    "ChunkedRecording",
    "Coefficient",
    "Critique",
    "Estimate",
    "Finding",
    "Fit",
    "FitError",
    "FleetResult",
    "Inspection",
    "LogNormal",
    "LogUniform",
    "Model",
    "ModifiedLogUniform",
    "Posterior",
    "PosteriorWarning",
    "PowerSpectrum",
    "Recording",
    "RecordingError",
    "SensorPreset",
    "TermSelection",
    "TermSet",
    "Uniform",
    "UnitError",
    "accumulate",
    "allan_deviation",
    "characterize_fleet",
    "convert",
    "critic",
    "critique",
    "enable_compilation_cache",
    "fit",
    "fit_many",
    "inspect",
    "load",
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
# A new term is named in its own room only.
__all__ += terms.__all__
