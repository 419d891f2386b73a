"""The command line as `python -m allanjax`."""

from allanjax.cli.app import main

if __name__ == "__main__":
    main()
