"""allanjax: noise coefficients of inertial sensors, with honest uncertainties."""

import jax

jax.config.update("jax_enable_x64", True)
