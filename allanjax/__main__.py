"""The command line as `allanjax` and as `python -m allanjax`."""

import os
import sys


def main() -> None:
    """Entry point of the command `allanjax`, which can be interrupted while it is being imported, too."""
    try:
        from allanjax.cli.app import main as run
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr, flush=True)
        os._exit(130)
    run()


if __name__ == "__main__":
    main()
