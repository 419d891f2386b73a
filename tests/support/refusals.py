"""What is refused, and by which words."""

from collections.abc import Callable
from typing import Any

import pytest

import allanjax as aj


def refuses(word: str, call: Callable, /, *given: Any, **options: Any) -> None:
    """Check that a call ends in an error of the package's own whose message matches."""
    with pytest.raises(aj.AllanjaxError, match=word):
        call(*given, **options)
