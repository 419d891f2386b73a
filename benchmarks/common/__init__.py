"""What the studies share. Writers of logs and the arithmetic of exports are those of the tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tests" / "support"))
