"""allanjax: noise coefficients of inertial sensors from a static recording, with honest uncertainties.

import allanjax as aj

recording = aj.read("imu.csv", rate=100, gyro_unit="deg/s", accel_unit="g")
fit = aj.fit(recording)
print(fit)
fit.plot()
"""

import os
import sys
from typing import Any

from allanjax import presentation  # noqa: F401 - gives results their methods, wherever these are imported from
from allanjax.base.late import late_names

# Allan variances of a long record span ten decades: single precision cannot hold them. Importing JAX takes
# half a second, so if it is not there yet, it is only set to start in double precision.
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    import jax

    jax.config.update("jax_enable_x64", True)

# Public names and the modules that define them are listed in `__init__.pyi`.
_load, __dir__ = late_names(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Object with this public name, imported at its first use; and `__version__`."""
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    public = globals()[name] = _load(name)
    return public
