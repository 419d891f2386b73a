"""Commands as a user types them."""

from click.testing import Result
from typer.testing import CliRunner

from allanjax.cli.app import app


def run(*words: object, given: bytes | None = None) -> Result:
    """What `allanjax` with these words, and this standard input, says and returns.

    Errors that no command expects are raised.
    """
    return CliRunner().invoke(app, [str(word) for word in words], input=given, catch_exceptions=False)
