"""The command `allanjax schema`."""

from typing import Annotated

import typer

from allanjax.cli.common import epilog, print_json
from allanjax.report.schemas import Name, schema

HELP = (
    "Print the JSON schema of what check, characterize (fit), critique, fleet or horizon writes: files and "
    "--json."
)
EPILOG = epilog("allanjax schema fit > fit.schema.json")


def command(
    name: Annotated[Name, typer.Argument(help="Of what.", metavar="check|fit|critique|fleet|horizon")],
) -> None:
    print_json(schema(name))
