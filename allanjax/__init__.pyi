# What users import, and where it comes from: read by type checkers, by editors, and by `__init__.py`.
# A new term is named in its own room only.

from allanjax import critic as critic
from allanjax.allan.deviation import AllanDeviation as AllanDeviation
from allanjax.allan.deviation import allan_deviation as allan_deviation
from allanjax.base.cache import enable_compilation_cache as enable_compilation_cache
from allanjax.base.errors import AllanjaxError as AllanjaxError
from allanjax.base.errors import FitError as FitError
from allanjax.base.errors import RecordingError as RecordingError
from allanjax.base.errors import UnitError as UnitError
from allanjax.critic import Cause as Cause
from allanjax.critic import Critique as Critique
from allanjax.critic import Finding as Finding
from allanjax.critic.critique import critique as critique
from allanjax.estimate.as_json import to_dict as to_dict
from allanjax.estimate.bulk import BulkFit as BulkFit
from allanjax.estimate.bulk import fit_many as fit_many
from allanjax.estimate.fit import fit as fit
from allanjax.estimate.loading import load as load
from allanjax.estimate.ranking import select_terms as select_terms
from allanjax.estimate.result import AxisFit as AxisFit
from allanjax.estimate.result import Fit as Fit
from allanjax.estimate.selection import AxisSelection as AxisSelection
from allanjax.estimate.selection import TermSelection as TermSelection
from allanjax.estimate.selection import TermSet as TermSet
from allanjax.fleet.fleet import FleetResult as FleetResult
from allanjax.fleet.fleet import characterize_fleet as characterize_fleet
from allanjax.fleet.stream import AllanAccumulator as AllanAccumulator
from allanjax.fleet.stream import accumulate as accumulate
from allanjax.inspection import Inspection as Inspection
from allanjax.inspection import inspect as inspect
from allanjax.noise import terms as terms
from allanjax.noise.estimate import Coefficient as Coefficient
from allanjax.noise.estimate import Estimate as Estimate
from allanjax.noise.model import Model as Model
from allanjax.noise.response import LowPass1 as LowPass1
from allanjax.noise.response import LowPass2 as LowPass2
from allanjax.noise.response import Response as Response
from allanjax.noise.sensors import SENSORS as SENSORS
from allanjax.noise.sensors import SensorPreset as SensorPreset
from allanjax.noise.simulate import simulate as simulate
from allanjax.noise.simulate import simulate_recording as simulate_recording
from allanjax.noise.terms import *
from allanjax.posterior.priors import LogNormal as LogNormal
from allanjax.posterior.priors import LogUniform as LogUniform
from allanjax.posterior.priors import ModifiedLogUniform as ModifiedLogUniform
from allanjax.posterior.priors import Uniform as Uniform
from allanjax.posterior.result import AxisPosterior as AxisPosterior
from allanjax.posterior.result import Posterior as Posterior
from allanjax.posterior.result import PosteriorWarning as PosteriorWarning
from allanjax.posterior.sample import sample as sample
from allanjax.record.io import ChunkedRecording as ChunkedRecording
from allanjax.record.io import read as read
from allanjax.record.io import read_chunks as read_chunks
from allanjax.record.io import write as write
from allanjax.record.recording import Axis as Axis
from allanjax.record.recording import Recording as Recording
from allanjax.record.units import convert as convert
from allanjax.report.allan_figure import plot_allan as plot_allan
from allanjax.report.files import write_coefficients_csv as write_coefficients_csv
from allanjax.report.files import write_curve_csv as write_curve_csv
from allanjax.report.files import write_json as write_json
from allanjax.report.spectrum_figure import plot_psd as plot_psd
from allanjax.spectrum.psd import PowerSpectrum as PowerSpectrum
from allanjax.spectrum.psd import power_spectrum as power_spectrum

__version__: str
