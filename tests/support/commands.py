"""Commands as a user types them."""

import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, NamedTuple
from unittest import mock

import allanjax.cli.app


class Result(NamedTuple):
    """Exit code of a command, and what it printed."""

    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        """Everything that it printed."""
        return self.stdout + self.stderr


def run(*words: object, given: bytes = b"", **environment: str) -> Result:
    """What `allanjax` with these words, standard input and environment says and returns."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.dict("os.environ", environment),
        mock.patch("sys.stdin", io.TextIOWrapper(io.BytesIO(given))),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        # Errors that no command expects are raised.
        try:
            allanjax.cli.app.run([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
    return Result(code, out.getvalue(), err.getvalue())


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
