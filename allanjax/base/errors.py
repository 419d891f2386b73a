"""Errors that allanjax raises for invalid input, and its warnings."""


class AllanjaxError(ValueError):
    """Base class of all errors that a user's input can cause; the message says what to do about it."""


class AllanjaxWarning(UserWarning):
    """Base class of all warnings by which allanjax, and no library, has something to say to its user."""


class UnitError(AllanjaxError):
    """A unit that is unknown, or whose dimension does not fit its use."""


class RecordingError(AllanjaxError):
    """A file or an array that is not a usable recording.

    `about` says what of it is wrong: "gaps", "jitter", "rate" or "dead axis"; "" for anything else.
    """

    def __init__(self, message: str, about: str = "") -> None:
        super().__init__(message)
        self.about = about


class MixedRatesError(RecordingError):
    """A table of several sensors, each with a rate of its own: `sensors` can be read one by one."""

    def __init__(self, message: str, sensors: tuple[str, ...]) -> None:
        super().__init__(message)
        self.sensors = sensors


class FitError(AllanjaxError):
    """A fit without a result: it did not converge, or the data cannot determine the model."""
