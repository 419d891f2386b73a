"""Parameters that commands share: how recordings are read and fitted, and what they are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token

from allanjax.base.errors import AllanjaxError
from allanjax.fleet.options import FitOptions
from allanjax.record.io.options import ReadOptions

if TYPE_CHECKING:
    from allanjax.noise.model import Model

#: One of the recordings that a command processes.
Recordings = Annotated[
    str,
    Parameter(
        name="FILE",
        required=True,
        help="Recordings: CSV and other text, Parquet, .npy, .npz, HDF5, .mat, TDMS, ROS bags "
        "(.bag, .db3, .mcap, or a folder), PX4 .ulg, ArduPilot .bin. Quoted patterns may contain * "
        "(any name) and ** (any folders); - reads standard input.",
    ),
]
#: File to write.
Written = Annotated[Path, Parameter(alias="-o")]
Figures = Literal["png", "svg", "pdf"]


@Parameter(name="*")
@dataclass(frozen=True)
class Reading(ReadOptions):
    """Options of reading, as given on a command line."""

    columns: str | None = None
    time: str | None = None


def _model(_: type, tokens: Sequence[Token]) -> "Model":
    """Model to fit that --terms describes."""
    from allanjax.noise.notation import parse_model

    model = parse_model(tokens[0].value)
    for p in model.parameters:
        if p.parameter.is_amplitude and p.start is not None:
            raise AllanjaxError(f"leave out the value of {p.label}: the fit estimates it")
    return model


def _names(_: type, tokens: Sequence[Token]) -> tuple[str, ...]:
    """Names that are separated by commas."""
    names = (name.strip() for name in tokens[-1].value.split(","))
    return tuple(name for name in names if name)


@Parameter(name="*")
@dataclass(frozen=True)
class Fitting:
    """Options of reading and fitting, as given on a command line.

    Attributes
    ----------
    terms
        Noise terms to fit, e.g. 'N + B + K' or 'quantization, angle_random_walk,
        markov(correlation_time=100 s held)'. By default the terms are selected from the five
        basic ones and a Markov process by their evidence.
    objective
        What to fit: the Allan variances; the Haar wavelet variances (by default with the five
        basic terms); the spectrum, with Whittle's likelihood (better for spectral lines); or the
        samples, with their exact likelihood (needs --terms; up to 100,000 samples).
    regressors
        Auxiliary columns to regress on, e.g. temperature; needs --objective whittle.
    as_is
        Use the whole recording, including disturbed parts.
    vibrating
        The platform is meant to move or vibrate: skip the test for rest.
    plain
        Fit the noise terms only. By default, if they do not fit the data, a filter, resonances
        and spectral lines are searched for, too.
    """

    reading: Reading = Reading()
    terms: Annotated[Any, Parameter(converter=_model, metavar="STR")] = None
    objective: Literal["allan", "wavelet", "whittle", "exact"] = "allan"
    regressors: Annotated[tuple[str, ...], Parameter(converter=_names, metavar="STR")] = ()
    as_is: bool = False
    vibrating: bool = False
    plain: bool = False

    @property
    def options(self) -> FitOptions:
        """The same options, as fits take them."""
        chosen = self.terms, self.objective, self.regressors
        return FitOptions(self.reading, *chosen, self.as_is, self.vibrating, self.plain)
