"""The critic's search in one axis from its beginning to its end."""

from collections.abc import Sequence

from allanjax.critic.cause import Cause
from allanjax.critic.search import Search, concluded, search
from allanjax.critic.view import View

#: Probability of a false finding in the axis.
FALSE_ALARMS = 2e-3


def searched(view: View, causes: Sequence[Cause]) -> Search:
    """What these causes find in a view, with nothing known of other axes."""
    return concluded(search(view, causes, FALSE_ALARMS, lambda text: None), causes)
