"""Where the studies find their parts, their results and the recordings of real sensors.

Each study imports this first: it lets them import `common`, the parts they share, and the generator of hidden
effects that the tests use.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
#: The folder of the real recordings, which are not part of the repository; None where it is not given.
DATA = Path(os.environ["ALLANJAX_DATA"]) if os.environ.get("ALLANJAX_DATA") else None

sys.path += [str(ROOT / "benchmarks"), str(ROOT / "tests" / "support")]
