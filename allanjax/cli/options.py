"""Commands and the options that they share, each declared once, so that no command can forget to pass one on.

Annotations declare a command's parameters. `@command` replaces the parameter `reading` by the
options of `ReadOptions`, and `options` by those of `FitOptions`, which include the former.
"""

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Vibrating, user_errors
from allanjax.cli.interrupt import INTERRUPTED
from allanjax.fleet.options import FitOptions
from allanjax.record.io.options import ReadOptions

if TYPE_CHECKING:
    from allanjax.noise.model import Model
    from allanjax.record.units import Sensor

#: Format of the figures that a command writes into a folder.
FigureFormat = Annotated[
    Literal["png", "svg", "pdf"], Option("--format", help="Format and suffix of the figures.")
]

# Types of the reading options that are numbers; the others are text.
_NUMBERS = {"rate": float, "start": float, "stop": float, "instance": int}

#: Functions of the commands and their help, by name.
COMMANDS: dict[str, tuple[Callable[..., None], dict[str, Any]]] = {}


def command(text: str, *examples: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator that makes a function a command of its name, with a text and examples as help."""
    text = " ".join(text.split())
    # In the list of commands: the first sentence, without its enumeration.
    short = re.split("[.:] ", text)[0].removesuffix(".")
    about = {"help": text, "short_help": short, "epilog": epilog(*examples) if examples else None}

    def registered(function: Callable[..., None]) -> Callable[..., None]:
        expanded = list(_expanded(function))

        def called(**values: Any) -> None:
            with user_errors():
                _call(function, values)

        called.__signature__ = inspect.Signature(expanded)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in expanded}
        COMMANDS[function.__name__] = called, about
        return function

    return registered


def epilog(*examples: str) -> str:
    """End of a command's help: examples and exit codes, in paragraphs as typer keeps no other line breaks."""
    codes = (
        "Exit codes: 0 success; 1 bad input or an axis without a result; 2 invalid command line; "
        f"{INTERRUPTED} interrupted."
    )
    return "\n\n".join(["Examples:", *(f"  {example}" for example in examples), codes])


def _expanded(function: Callable[..., Any]) -> Iterator[inspect.Parameter]:
    """Parameters of a function; a parameter with a builder is replaced by the builder's parameters."""
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in _BUILDERS:
            yield from _expanded(_BUILDERS[parameter.name])
        else:
            yield parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)


def _call(function: Callable[..., Any], values: dict[str, Any]) -> Any:
    """Call a function with the values that it takes, after builders have combined them."""
    return function(
        **{
            name: _call(_BUILDERS[name], values) if name in _BUILDERS else values[name]
            for name in inspect.signature(function).parameters
        }
    )


def _read_options(**values: Any) -> ReadOptions:
    """Reading options; typer.BadParameter if they are invalid."""
    try:
        return ReadOptions(**values)
    except AllanjaxError as error:
        raise typer.BadParameter(str(error)) from error


_read_options.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [
        inspect.Parameter(
            option.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                _NUMBERS.get(option.name, str) | None,
                Option(help=option.metadata["help"]),
            ],
        )
        for option in fields(ReadOptions)
    ]
)


def _fit_options(
    reading: ReadOptions,
    terms: Annotated[
        str | None,
        Option(
            help="Noise terms to fit, e.g. 'N + B + K' or 'quantization, angle_random_walk, "
            "markov(correlation_time=100 s held)'. By default the terms are selected from the "
            "five basic ones and a Markov process by their evidence."
        ),
    ] = None,
    objective: Annotated[
        Literal["allan", "wavelet", "whittle", "exact"],
        Option(
            help="What to fit: the Allan variances; the Haar wavelet variances (by default with "
            "the five basic terms); the spectrum, with Whittle's likelihood (better for spectral "
            "lines); or the samples, with their exact likelihood (needs --terms; up to 100,000 "
            "samples)."
        ),
    ] = "allan",
    regressors: Annotated[
        str | None,
        Option(
            help="Auxiliary columns to regress on, e.g. temperature; needs --objective whittle.",
        ),
    ] = None,
    as_is: Annotated[
        bool, Option("--as-is", help="Use the whole recording, including disturbed parts.")
    ] = False,
    vibrating: Vibrating = False,
    plain: Annotated[
        bool,
        Option(
            "--plain",
            help="Fit the noise terms only. By default, if they do not fit the data, a filter, "
            "resonances and spectral lines are searched for, too.",
        ),
    ] = False,
) -> FitOptions:
    """Options of fits."""
    model = None if terms is None else parsed_model(terms)
    for p in () if model is None else model.parameters:
        if p.parameter.is_amplitude and p.start is not None:
            message = f"leave out the value of {p.label}: the fit estimates it"
            raise typer.BadParameter(message, param_hint="--terms")
    names = (name.strip() for name in (regressors or "").split(","))
    return FitOptions(
        reading, model, objective, tuple(name for name in names if name), as_is, vibrating, plain
    )


_BUILDERS: dict[str, Callable[..., Any]] = {"reading": _read_options, "options": _fit_options}


def parsed_model(terms: str, sensor: "Sensor | None" = None) -> "Model":
    """Model described by --terms; typer.BadParameter if the text is invalid."""
    from allanjax.noise.notation import parse_model

    try:
        return parse_model(terms, sensor)
    except AllanjaxError as error:
        raise typer.BadParameter(str(error), param_hint="--terms") from error
