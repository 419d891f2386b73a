"""How long does a page take, how large is it, and how much memory does it add?

A record of six axes with a random walk, a line, a step and an outlier is fitted and criticized in a process
of its own; then its page is made, twice: the first one also loads the template. Memory is the peak of the
process after the page less that before it. The page of a fleet has made-up units of six axes and three
coefficients each. Pages are opened by no browser here; the tests do that.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks.common.study import process, table

QUICK: dict[str, Any] = {"samples": 20_000, "units": 50}
RECORD = """
import resource, sys, time, numpy as np, allanjax as aj
aj.enable_compilation_cache()
n, rng = int(sys.argv[1]), np.random.default_rng(1)
x = 0.3 * rng.standard_normal((n, 6))
x += np.cumsum(rng.standard_normal((n, 6)) * 2e-5, axis=0)
x[:, 1] += 0.02 * np.sin(2 * np.pi * 7.3 * np.arange(n) / 100.0)
x[n // 2 :, 2] += 0.02
x[n // 3, 4] += 5.0
names = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
record = aj.Recording.from_array(x, 100.0, gyro_unit="deg/s", accel_unit="m/s²", names=names)
del x
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
begun = time.perf_counter()
fit = aj.fit(record)
fitted = time.perf_counter()
critique = aj.critique(record) if sys.argv[2] == "critique" else None
done, before = time.perf_counter(), peak()
page = aj.report(fit, critique=critique, recording=record)
made, after = time.perf_counter(), peak()
aj.report(fit, critique=critique, recording=record)
findings = 0 if critique is None else len(critique.findings)
print(fitted - begun, done - fitted, made - done, time.perf_counter() - made, after - before,
      len(page.html) / 1e6, findings)
"""
FLEET = """
import resource, sys, time, numpy as np, pandas as pd, allanjax as aj
units, rng = int(sys.argv[1]), np.random.default_rng(2)
axes = [f"{s}_{k}" for s in ("gyro", "accel") for k in "xyz"]
labels = {"angle_random_walk": ("deg/√h", "m/s/√h"), "bias_instability": ("deg/h", "µg"),
          "rate_random_walk": ("deg/h/√h", "m/s/h/√h")}
rows = [(f"unit {u}", axis, axis[:-2], label, of[axis[0] == "a"])
        for u in range(units) for axis in axes for label, of in labels.items()]
frame = pd.DataFrame(rows, columns=["recording", "axis", "sensor", "coefficient", "unit"])
value = np.exp(0.1 * rng.standard_normal(len(frame)))
frame = frame.assign(value=value, std=0.02 * value, lower_95=0.96 * value, upper_95=1.04 * value)
frame = frame.assign(file="f", group="", detected=True, measured=True, upper_limit_95=np.nan, p_value=0.5)
frame = frame.assign(terms="", remarks="", warnings="", outlying=value > 1.33)
fleet = aj.FleetResult(frame, (), (), 0)
begun = time.perf_counter()
page = aj.report(fleet, pages={f"unit {u}": f"recordings/unit{u}.html" for u in range(units)})
print(time.perf_counter() - begun, len(page.html) / 1e6)
"""


def run(*, samples: int = 1_000_000, units: int = 1000) -> Iterator[str]:
    rows = []
    for what in ("fit", "critique"):
        printed, *_ = process(RECORD, samples, what)
        fitted, criticized, first, second, memory, size, findings = map(float, printed.split())
        before = f"{fitted:.1f}" if what == "fit" else f"{fitted:.1f} + {criticized:.1f}"
        rows.append(
            [what, before, f"{findings:.0f}", f"{first:.2f}", f"{second:.2f}", f"{memory:.0f}", f"{size:.2f}"]
        )
    yield f"## A record of six axes, {samples:,} samples each"
    head = ["page of", "before [s]", "findings", "page [s]", "again [s]", "more memory [MB]", "size [MB]"]
    yield table(head, rows)
    printed, *_ = process(FLEET, units)
    taken, size = map(float, printed.split())
    yield f"## A fleet\n\nThe page of {units:,} units takes {taken:.2f} s and has {size:.2f} MB."
