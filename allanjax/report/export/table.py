"""The table of targets, by name: a new one is an entry in `estimators` or `simulators`."""

from __future__ import annotations

from collections.abc import Mapping

from allanjax.report.export.estimators import ESTIMATORS
from allanjax.report.export.simulators import AUTOPILOTS, SIMULATORS
from allanjax.report.export.targets import Target

TARGETS: Mapping[str, Target] = {target.name: target for target in (*ESTIMATORS, *SIMULATORS, *AUTOPILOTS)}
