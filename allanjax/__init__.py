"""allanjax: noise coefficients of inertial sensors from a static recording, with honest uncertainties.

import allanjax as aj

recording = aj.read("imu.csv", rate=100, gyro_unit="deg/s", accel_unit="g")
fit = aj.fit(recording)
print(fit)
fit.plot()
"""

from pathlib import Path
from typing import Any

import jax

# Allan variances of a long record span ten decades: single precision cannot hold them.
jax.config.update("jax_enable_x64", True)

from allanjax import report  # noqa: F401 - gives results their methods, wherever these are imported from
from allanjax.base.late import LateNames

# What is public, and where it comes from, is listed in `__init__.pyi`.
_PUBLIC = LateNames(__name__, Path(__file__).with_suffix(".pyi"))


def __getattr__(name: str) -> Any:
    """What has this public name, loaded when it is asked for the first time; and `__version__`."""
    if name == "__version__":
        from importlib.metadata import version

        return version(__name__)
    found = globals()[name] = _PUBLIC.load(name)
    return found


def __dir__() -> list[str]:
    return _PUBLIC.all()
