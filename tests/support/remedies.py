"""The remedies that a message offers, as options of `read`; and what comes of them."""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import allanjax as aj

_NAMES = "rate|gyro_unit|accel_unit|columns|names|time|time_unit|start|stop|topic|instance|gaps|force|chunk"
_OPTION = re.compile(rf"\b({_NAMES})=(?:'([^']*)'|([\d.]*\d)|(True))?")
# Options as commands take them, in brackets behind those of Python.
_COMMAND = re.compile(r"\s*\((--(?:[^()]|\([^()]*\))*)\)")
#: The value of an option that is to be left out.
OMIT = "omit"
#: One remedy: options and their values; None where users know the value.
Remedy = dict[str, str | None]


def remedies(message: str) -> list[Remedy]:
    """The remedies that a message offers behind what is wrong, in their order."""
    text = _COMMAND.sub("", message)
    found: list[Remedy] = []
    for clause in re.split(r"; |,? or ", text.partition("; ")[2] or text):
        options: Remedy = {name: "".join(values) or None for name, *values in _OPTION.findall(clause)}
        if re.search(r"\bomit\b", clause):
            options = dict.fromkeys(options or [_OPTION.findall(text)[0][0]], OMIT)
        if options and options not in found:
            found.append(options)
    return found


def commands(message: str) -> dict[str, str]:
    """The options that a message has in their form for commands, and their values if it has them."""
    found = {}
    for group in _COMMAND.findall(message):
        for name, quoted, value in re.findall(r"--([a-z-]+)(?: (?:'([^']*)'|([^\s;']+)))?", group):
            found[name.replace("-", "_")] = quoted or value.rstrip(",")
    return found


def of_python(message: str) -> dict[str, str]:
    """The options that a message has in their form for Python, and their values if it has them."""
    return {name: "".join(values) for name, *values in _OPTION.findall(_COMMAND.sub("", message))}


class Followed(NamedTuple):
    """What comes of following remedies: a recording or a refusal, and the options of each step."""

    recording: aj.Recording | None
    steps: tuple[Mapping[str, Any], ...]
    message: str


def follow(
    read: Callable[..., aj.Recording], known: Mapping[str, Any], steps: int = 3, **options: Any
) -> Followed:
    """Follow the first remedy of each message that can be followed with what a user knows.

    Args:
        read: reads with options.
        known: values of options that the user knows.
        steps: the most remedies that are followed.
        options: options of the first reading.
    """
    told: tuple[Mapping[str, Any], ...] = ()
    while True:
        try:
            return Followed(read(**options), told, "")
        except aj.AllanjaxError as error:
            message = str(error)
        choices = [with_values(remedy, known) for remedy in remedies(message)]
        usable = [x for x in choices if x is not None and not x.items() <= options.items()]
        if len(told) == steps or not usable:
            return Followed(None, told, message)
        options |= usable[0]
        told = (*told, usable[0])


def with_values(remedy: Remedy, known: Mapping[str, Any]) -> dict[str, Any] | None:
    """Options of a remedy with their values; None if a user does not know one."""
    found: dict[str, Any] = {}
    for name, value in remedy.items():
        given = known.get(name) if value is None else value
        if given is None:
            return None
        if value == OMIT:
            given = None
        elif name == "force":
            given = True
        elif name in ("start", "stop", "rate"):
            given = float(given)
        found[name] = given
    return found
