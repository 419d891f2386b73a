"""The critic: what a simulation of the fitted sensor gets wrong, why, and how much a correction gains.

To add an effect whose waveform is known except for its amplitude and one parameter, make a `Template` from a
function and the values of the parameter. Any other effect is a subclass of `Effect` with a `name` and a
method `detect(view)`, which takes a `View` of one axis and returns its best `Candidate`, or None. The
candidate's parameters are `Estimate`s made by `View.estimate`, `time_estimate`, `amplitude_estimate` or
`log_estimate`. Shapes that are known except for some parameters go into a `Bank`, after `centred`, and
`additive` finds the best of them. `Effect.sensible` has a `Range` for each parameter in which it makes
sense. `critic.search` has the rule by which a candidate becomes a finding.
"""

from allanjax.base.late import late_names

# `__init__.pyi` lists the public names and where they come from.
__getattr__, __dir__ = late_names(__name__, __file__)
