"""Commands as a user types them."""

from click.testing import Result
from typer.testing import CliRunner

from allanjax.cli.app import app


def run(*words: object) -> Result:
    """What `allanjax` with these words says and returns; errors that no command expects are raised."""
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
