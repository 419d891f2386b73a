"""Where the repository lies, and real recordings, which are not part of it."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: The folder that ALLANJAX_DATA names; tests that read a recording are left out where it is not there.
DATA = Path(os.environ.get("ALLANJAX_DATA", ROOT.parent / "shared" / "data")).resolve()
