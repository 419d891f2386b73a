"""Errors that allanjax raises for invalid input, and its warnings."""


class AllanjaxError(ValueError):
    """Base class of all errors caused by user input; the message says how to correct it."""


class AllanjaxWarning(UserWarning):
    """Base class of the warnings that allanjax itself, and no library, issues."""


def expect(value: object, kinds: type | tuple[type, ...], wanted: str) -> None:
    """Raise AllanjaxError unless a value is of these kinds; `wanted` tells what takes what, in words."""
    if not isinstance(value, kinds):
        shown = repr(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
        raise AllanjaxError(f"{wanted}, not {shown}")


class UnitError(AllanjaxError):
    """A unit is unknown or has the wrong dimension."""


class RecordingError(AllanjaxError):
    """A file or an array is not a usable recording.

    `about` is the kind of problem: "gaps", "jitter", "rate" or "dead axis"; "" for any other.
    """

    def __init__(self, message: str, about: str = "") -> None:
        super().__init__(message)
        self.about = about


class MixedRatesError(RecordingError):
    """The sensors in a table have different rates; each of `sensors` can be read by itself."""

    def __init__(self, message: str, sensors: tuple[str, ...]) -> None:
        super().__init__(message)
        self.sensors = sensors


class FitError(AllanjaxError):
    """A fit has no result: it did not converge, or the data cannot determine the model."""
