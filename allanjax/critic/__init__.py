"""The critic: what a simulation of the fitted sensor gets wrong, why, and what is gained by mending it.

A cause of one's own whose waveform is known but for its amplitude and one parameter is a `Template`: a
function and the values of the parameter. Any other is a subclass of `Cause` with a `name` and a method
`detect(view)`, which is handed a `View` of one axis and returns its best `Candidate`, or None. The
candidate's parameters are `Estimate`s, made by `View.estimate`, `time_estimate`, `amplitude_estimate` or
`log_estimate`. A shape that is known up to some parameters goes into a `Bank` of such shapes, `centred`, and
`additive` finds the best of them. What is asked of a candidate before it is a finding is in `critic.policy`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from allanjax.critic.cause import Cause
from allanjax.critic.finding import Discrepancy, Finding, Rival
from allanjax.critic.result import AxisCritique, Critique
from allanjax.critic.view import Candidate, View

if TYPE_CHECKING:
    from allanjax.critic.bank import Bank
    from allanjax.critic.causes import CAUSES
    from allanjax.critic.causes.additive import additive
    from allanjax.critic.causes.template import Template
    from allanjax.critic.noise import centred

# What only an author of causes needs, and takes long to load.
_LATE = {
    "Bank": "bank",
    "CAUSES": "causes",
    "Template": "causes.template",
    "additive": "causes.additive",
    "centred": "noise",
}

__all__ = [
    "CAUSES",
    "AxisCritique",
    "Bank",
    "Candidate",
    "Cause",
    "Critique",
    "Discrepancy",
    "Finding",
    "Rival",
    "Template",
    "View",
    "additive",
    "centred",
]


def __getattr__(name: str) -> Any:
    """What a cause of one's own needs, loaded when it is asked for."""
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
