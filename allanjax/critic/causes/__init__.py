"""The causes that the critic knows, one class per file."""

from allanjax.critic.cause import Cause
from allanjax.critic.causes.basic_term import BasicTerm
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.causes.disturbance import Disturbance
from allanjax.critic.causes.outliers import Outliers
from allanjax.critic.causes.power_law import PowerLaw
from allanjax.critic.causes.repeated_samples import RepeatedSamples
from allanjax.critic.causes.rounding import Rounding
from allanjax.critic.causes.saturation import Saturation
from allanjax.critic.causes.sinusoid import Sinusoid
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.causes.telegraph import Telegraph
from allanjax.critic.causes.temperature import Temperature
from allanjax.critic.causes.variance_change import VarianceChange
from allanjax.critic.causes.warm_up import WarmUp
from allanjax.critic.view import EVERYTHING

#: The causes that a critique looks for by default.
CAUSES: tuple[Cause, ...] = (
    *(BasicTerm(term) for term in EVERYTHING),
    BiasStep(),
    Disturbance(),
    Outliers(),
    PowerLaw(),
    RepeatedSamples(),
    Rounding(),
    Saturation(),
    Sinusoid(),
    SpectralShape(),
    Telegraph(),
    Temperature(),
    VarianceChange(),
    WarmUp(),
)
