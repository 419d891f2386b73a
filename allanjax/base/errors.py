"""The errors that allanjax raises for what a user gives it."""


class AllanjaxError(ValueError):
    """Base of all errors that a user's input can cause; its message says what to do about it."""


class UnitError(AllanjaxError):
    """A unit that is unknown, or whose dimension does not fit its use."""


class RecordingError(AllanjaxError):
    """A file or an array that is not a usable recording."""


class FitError(AllanjaxError):
    """A fit that gives no result: it did not converge, or the data cannot determine the model."""
