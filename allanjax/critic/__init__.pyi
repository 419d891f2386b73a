# What users import, and where it comes from, as `allanjax/__init__.pyi` has it.

from allanjax.critic.bank import Bank as Bank
from allanjax.critic.bank import Template as Template
from allanjax.critic.bank import additive as additive
from allanjax.critic.effect import Candidate as Candidate
from allanjax.critic.effect import Effect as Effect
from allanjax.critic.effect import Range as Range
from allanjax.critic.effect import View as View
from allanjax.critic.effects import EFFECTS as EFFECTS
from allanjax.critic.finding import Discrepancy as Discrepancy
from allanjax.critic.finding import Finding as Finding
from allanjax.critic.finding import Rival as Rival
from allanjax.critic.noise import centred as centred
from allanjax.critic.result import AxisCritique as AxisCritique
from allanjax.critic.result import Critique as Critique
