"""Options that commands share, each declared once: a command takes one object for all of a kind.

`@with_options` gives a command, for its parameter `reading`, the options of `ReadOptions`, and for its
parameter `options` those of `FitOptions`, the former among them. So no command can forget to pass one on.
"""

import functools
import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Vibrating
from allanjax.fleet.options import FitOptions
from allanjax.record.io.options import ReadOptions
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    from allanjax.noise.model import Model

# Options of reading that are numbers; the others are text.
_NUMBERS = {"rate": float, "start": float, "stop": float, "instance": int}


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Command with options in place of the parameters `reading` and `options` of a function."""
    expanded = list(_expanded(command))

    @functools.wraps(command)
    def called(**values: Any) -> None:
        _call(command, values)

    called.__signature__ = inspect.Signature(expanded)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in expanded}
    return called


def _expanded(function: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Parameters of a function, those of a builder in place of what it builds."""
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in _BUILDERS:
            yield from _expanded(_BUILDERS[parameter.name])
        else:
            yield parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)


def _call(function: Callable[..., Any], values: dict[str, Any]) -> Any:
    """Call a function with those of the values that it takes, after builders have combined them."""
    return function(
        **{
            name: _call(_BUILDERS[name], values) if name in _BUILDERS else values[name]
            for name in inspect.signature(function).parameters
        }
    )


def _read_options(**values: Any) -> ReadOptions:
    """Options of reading, or a wrong command line."""
    try:
        return ReadOptions(**values)
    except AllanjaxError as error:
        raise typer.BadParameter(str(error), param_hint="--start, --stop, --gaps") from error


_read_options.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [
        inspect.Parameter(
            option.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                _NUMBERS.get(option.name, str) | None, typer.Option(help=option.metadata["help"])
            ],
        )
        for option in fields(ReadOptions)
    ]
)


def _fit_options(
    reading: ReadOptions,
    terms: Annotated[
        str | None,
        typer.Option(
            help="Noise terms to fit, e.g. 'N + B + K' or 'quantization, angle_random_walk, "
            "markov(correlation_time=100 s held)'. Without: those of the five basic terms and a Markov "
            "process that the data call for, by their evidence."
        ),
    ] = None,
    objective: Annotated[
        Literal["allan", "wavelet", "whittle", "exact"],
        typer.Option(
            help="Fit the Allan variances, the Haar wavelet variances (the five basic terms, if none are "
            "given), the spectrum by Whittle's likelihood (better for lines), or the samples by their exact "
            "likelihood (given terms, up to 100,000 samples)."
        ),
    ] = "allan",
    regressors: Annotated[
        str | None,
        typer.Option(help="Auxiliary columns to regress on, with --objective whittle, e.g. temperature."),
    ] = None,
    as_is: Annotated[
        bool,
        typer.Option("--as-is", help="Use all of a recording, also where it was handled or disturbed."),
    ] = False,
    vibrating: Vibrating = False,
    plain: Annotated[
        bool,
        typer.Option(
            "--plain",
            help="The plain noise terms only, also where they do not follow the data; else a filter, "
            "resonances and lines are looked for there.",
        ),
    ] = False,
) -> FitOptions:
    model = None if terms is None else parsed_model(terms)
    for p in () if model is None else model.parameters:
        if p.parameter.is_amplitude and p.start is not None:
            wrong = f"{p.label} is what the fit estimates; leave out its value"
            raise typer.BadParameter(wrong, param_hint="--terms")
    names = (name.strip() for name in (regressors or "").split(","))
    return FitOptions(
        reading, model, objective, tuple(name for name in names if name), as_is, vibrating, plain
    )


_BUILDERS: dict[str, Callable[..., Any]] = {"reading": _read_options, "options": _fit_options}


def parsed_model(terms: str, sensor: Sensor | None = None) -> "Model":
    """Model that --terms describes, or a wrong command line."""
    from allanjax.noise.notation import parse_model

    try:
        return parse_model(terms, sensor)
    except AllanjaxError as error:
        raise typer.BadParameter(str(error), param_hint="--terms") from error
