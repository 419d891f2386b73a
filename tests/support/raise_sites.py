"""Where modules of the package make errors, and which of these places calls have reached."""

import ast
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import allanjax as aj

_ROOT = Path(aj.__file__).parent
_MAKERS = {"error", "unit_error", "no_rows", "_error", "RecordingError", "UnitError", "AllanjaxError"}

#: A place: the file, and the first and the last line of the call that makes the error.
Place = tuple[str, int, int]


def places(*folders: str) -> dict[Place, str]:
    """The places in modules of these folders of the package, and the text there."""
    found = {}
    for path in sorted(path for folder in folders for path in (_ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in _MAKERS:
                key = str(path.relative_to(_ROOT)), node.lineno, node.end_lineno or node.lineno
                found[key] = ast.get_source_segment(text, node) or ""
    return found


@contextmanager
def reached() -> Iterator[set[tuple[str, int]]]:
    """Collect files and lines of all calls within the package from which errors are made."""
    lines: set[tuple[str, int]] = set()
    begin = aj.AllanjaxError.__init__

    def init(self: Exception, *given: object, **named: object) -> None:
        frame = inspect.currentframe()
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if _ROOT in path.parents:
                lines.add((str(path.relative_to(_ROOT)), frame.f_lineno))
            frame = frame.f_back
        begin(self, *given, **named)

    with mock.patch.object(aj.AllanjaxError, "__init__", init):
        yield lines
