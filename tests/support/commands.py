"""Commands as a user types them."""

import json
import re
from typing import Any

from typer.testing import CliRunner, Result

from allanjax.cli.app import app


def run(*words: object, given: bytes | None = None, **environment: str) -> Result:
    """What `allanjax` with these words, standard input and environment says and returns."""
    # Errors that no command expects are raised.
    said = [str(word) for word in words]
    return CliRunner().invoke(app, said, given, environment, catch_exceptions=False)


def without_progress(stderr: str) -> str:
    """What a command wrote beside the lines by which slow machines report progress."""
    return re.sub(r"^.*, \d+ s\n", "", stderr, flags=re.MULTILINE)


def schema(name: str) -> Any:
    """Validator of the documents whose schema `allanjax schema NAME` prints."""
    # Here, as it takes seconds to import.
    from jsonschema import Draft202012Validator

    printed = json.loads(run("schema", name).stdout)
    Draft202012Validator.check_schema(printed)
    return Draft202012Validator(printed)
