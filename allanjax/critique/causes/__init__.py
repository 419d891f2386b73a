"""The causes that the critic knows, one class a file."""

from allanjax.critique.causes.basic_term import BasicTerm
from allanjax.critique.causes.bias_step import BiasStep
from allanjax.critique.causes.disturbance import Disturbance
from allanjax.critique.causes.low_pass import LowPass
from allanjax.critique.causes.outliers import Outliers
from allanjax.critique.causes.power_law import PowerLaw
from allanjax.critique.causes.repeated_samples import RepeatedSamples
from allanjax.critique.causes.resonance import Resonance
from allanjax.critique.causes.rounding import Rounding
from allanjax.critique.causes.saturation import Saturation
from allanjax.critique.causes.sinusoid import Sinusoid
from allanjax.critique.causes.telegraph import Telegraph
from allanjax.critique.causes.temperature import Temperature
from allanjax.critique.causes.variance_change import VarianceChange
from allanjax.critique.causes.warm_up import WarmUp
from allanjax.critique.view import EVERYTHING, Cause

#: What a critique looks for, unless told otherwise.
CAUSES: tuple[Cause, ...] = (
    *(BasicTerm(term) for term in EVERYTHING),
    BiasStep(),
    Disturbance(),
    LowPass(),
    Outliers(),
    PowerLaw(),
    RepeatedSamples(),
    Resonance(),
    Rounding(),
    Saturation(),
    Sinusoid(),
    Telegraph(),
    Temperature(),
    VarianceChange(),
    WarmUp(),
)
