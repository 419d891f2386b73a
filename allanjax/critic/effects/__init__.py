"""The effects that the critic knows, one class per file."""

from allanjax.critic.effect import EVERYTHING, Effect
from allanjax.critic.effects.basic_term import BasicTerm
from allanjax.critic.effects.bias_step import BiasStep
from allanjax.critic.effects.disturbance import Disturbance
from allanjax.critic.effects.outliers import Outliers
from allanjax.critic.effects.power_law import PowerLaw
from allanjax.critic.effects.repeated_samples import RepeatedSamples
from allanjax.critic.effects.rounding import Rounding
from allanjax.critic.effects.saturation import Saturation
from allanjax.critic.effects.sinusoid import Sinusoid
from allanjax.critic.effects.slow_change import SlowChange
from allanjax.critic.effects.spectral_shape import SpectralShape
from allanjax.critic.effects.telegraph import Telegraph
from allanjax.critic.effects.temperature import Temperature
from allanjax.critic.effects.variance_change import VarianceChange
from allanjax.critic.effects.warm_up import WarmUp

#: The effects that a critique looks for by default.
EFFECTS: tuple[Effect, ...] = (
    *(BasicTerm(term) for term in EVERYTHING),
    *(BiasStep(), Disturbance(), Outliers(), PowerLaw(), RepeatedSamples(), Rounding(), Saturation()),
    *(Sinusoid(), SlowChange(), SpectralShape(), Telegraph(), Temperature(), VarianceChange(), WarmUp()),
)
