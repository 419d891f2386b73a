"""The command `allanjax schema`."""

from typing import Annotated, Literal

import typer

from allanjax.cli.common import epilog, print_json

HELP = "Print the JSON schema of what check, characterize, critique, fleet or horizon writes."
EPILOG = epilog("allanjax schema fit > fit.schema.json")


def command(
    name: Annotated[
        Literal["check", "fit", "critique", "fleet", "horizon"],
        typer.Argument(help="Which schema; fit is that of characterize.", metavar="NAME"),
    ],
) -> None:
    from allanjax.report.schemas import schema

    print_json(schema(name))
