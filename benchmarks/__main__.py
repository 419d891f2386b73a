"""Run studies: `python -m benchmarks NAME [options]`, `--list`, `--all --quick`."""

from __future__ import annotations

import argparse
import inspect
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common.study import UnavailableError, WrongError, names, perform, question, settings, study


def main(arguments: list[str] | None = None) -> int:
    """Return 1 if a study failed or contradicts a claim, 2 if none was named, else 0."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Studies that check the claims of allanjax. Each writes its answer to "
        "benchmarks/results/NAME.md, with the commit, the machine and the versions.",
        epilog="`python -m benchmarks NAME --help` has the options of a study.",
        add_help=False,
        allow_abbrev=False,
    )
    parser.add_argument("name", nargs="?", choices=names(), metavar="NAME", help="a study")
    parser.add_argument("--list", action="store_true", help="list all studies with their questions")
    parser.add_argument("--all", action="store_true", help="run all of them")
    parser.add_argument("--quick", action="store_true", help="small numbers, to check that the studies run")
    parser.add_argument("--workers", type=int, help="number of processes, by default 2, or 1 with --quick")
    parser.add_argument("--keep", type=Path, help="folder for finished tasks; a later run resumes from it")
    parser.add_argument("--results", type=Path, help="file of the results")
    options, own = parser.parse_known_args(arguments)
    settings.workers = options.workers or (1 if options.quick else 2)
    settings.keep = options.keep
    if options.list:
        width = max(map(len, names()))
        print("\n".join(f"{name:<{width}}  {question(name)}" for name in names()))
        return 0
    if options.all:
        return int(any([not ran(name, options.quick) for name in names()]))  # noqa: C419 - all are to run
    if options.name is None:
        parser.print_help()
        return 2
    given = options_of(options.name, parser, own)
    return int(not ran(options.name, options.quick, options.results, **given))


def ran(name: str, quick: bool, results: Path | None = None, **given: Any) -> bool:
    """Whether a study ended well; what goes wrong is told, so that others can run after it."""
    begun = time.perf_counter()
    try:
        perform(name, quick, results, **given)
        told = "done"
    except UnavailableError as reason:
        told = f"not run: {reason}"
    except WrongError as what:
        told = f"WRONG: {what}"
    except Exception:
        told = f"FAILED: {traceback.format_exc()}"
    print(f"{name}: {told} ({time.perf_counter() - begun:.0f} s)", file=sys.stderr, flush=True)
    return told.startswith(("done", "not run"))


def options_of(name: str, common: argparse.ArgumentParser, own: list[str]) -> dict[str, Any]:
    """The study's own options: the keywords of its `run`."""
    module = study(name)
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=inspect.getdoc(module),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=common.format_help(),
        argument_default=argparse.SUPPRESS,
    )
    for key, parameter in inspect.signature(module.run).parameters.items():
        kind = _kind_of(parameter.default)
        how = {"action": "store_true"} if parameter.default is False else {"type": kind}
        parser.add_argument(f"--{key.replace('_', '-')}", help=f"{parameter.default!r} if not given", **how)
    return vars(parser.parse_args(own))


def _kind_of(default: Any) -> Callable[[str], Any]:
    """How an option is read: as its default is, lists with commas."""
    if isinstance(default, tuple):
        kind = type(default[0]) if default else str
        return lambda text: tuple(kind(part) for part in text.split(",") if part)
    return type(default)


if __name__ == "__main__":
    sys.exit(main())
