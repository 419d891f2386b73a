"""Errors that allanjax raises for invalid input."""


class AllanjaxError(ValueError):
    """Base class of all errors that a user's input can cause; the message says what to do about it."""


class UnitError(AllanjaxError):
    """A unit that is unknown, or whose dimension does not fit its use."""


class RecordingError(AllanjaxError):
    """A file or an array that is not a usable recording."""


class FitError(AllanjaxError):
    """A fit without a result: it did not converge, or the data cannot determine the model."""
