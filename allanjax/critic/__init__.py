"""The critic: what a simulation of the fitted sensor gets wrong, why, and what is gained by mending it.

A cause of one's own whose waveform is known but for its amplitude and one parameter is a `Template`: a
function and the values of the parameter. Any other is a subclass of `Cause` with a `name` and a method
`detect(view)`, which is handed a `View` of one axis and returns its best `Candidate`, or None. The
candidate's parameters are `Estimate`s, made by `View.estimate`, `time_estimate`, `amplitude_estimate` or
`log_estimate`. A shape that is known up to some parameters goes into a `Bank` of such shapes, `centred`, and
`additive` finds the best of them. What is asked of a candidate before it is a finding is in `critic.policy`.
"""

from pathlib import Path
from typing import Any

from allanjax.base.late import LateNames

# What is public, and where it comes from, is listed in `__init__.pyi`.
_PUBLIC = LateNames(__name__, Path(__file__).with_suffix(".pyi"))


def __getattr__(name: str) -> Any:
    """What has this public name, loaded when it is asked for."""
    return _PUBLIC.load(name)


def __dir__() -> list[str]:
    return _PUBLIC.all()
