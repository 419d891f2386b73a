"""The command line as `allanjax` and as `python -m allanjax`."""

from allanjax.cli.interrupt import end_on_interrupt


def main() -> None:
    """Entry point of the command `allanjax`, which can be interrupted while it is being imported, too."""
    end_on_interrupt()
    from allanjax.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
