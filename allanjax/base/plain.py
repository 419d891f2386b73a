"""Text for an output that can not show all of it: `deg/sqrt(h)`, `+-`, `tau` where there is no Unicode."""

import codecs
import io
import re
import sys
import unicodedata
from typing import TextIO

ERRORS = "allanjax"
"""Name of the error handler that writes such words, for `str.encode` and for streams."""

_ROOT = re.compile(r"√([A-Za-z]+)")
_RAISED = re.compile("[⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻]+")
_LEVEL = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻", "0123456789+-")
_WORDS = {
    "√": "sqrt",
    "±": "+-",
    "·": "*",
    "×": "x",
    "µ": "u",
    "μ": "u",
    "°": "deg",
    "…": "...",
    "–": "-",
    "—": "-",
    "−": "-",
    "→": "->",
    "←": "<-",
    "≤": "<=",
    "≥": ">=",
    "≪": "<<",
    "≫": ">>",
    "≈": "~",
    "≠": "!=",
    "∞": "inf",
    "½": "1/2",
    "∑": "sum",
    "∫": "integral",
    "‘": "'",
    "’": "'",
    "“": '"',
    "”": '"',
}


def _in_words(error: UnicodeError) -> tuple[str, int]:
    """What to write instead of a character that can not be, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text, at = error.object, error.start
    if root := _ROOT.match(text, at):
        return f"sqrt({root[1]})", root.end()
    if raised := _RAISED.match(text, at):
        return f"^{raised[0].translate(_LEVEL)}", raised.end()
    return _word(text[at]), at + 1


def _word(character: str) -> str:
    if character in _WORDS:
        return _WORDS[character]
    name = unicodedata.name(character, "")
    if found := re.fullmatch(r"GREEK (SMALL|CAPITAL) LETTER ([A-Z]+)", name):
        return found[2].lower() if found[1] == "SMALL" else found[2].capitalize()
    if name.startswith("BOX DRAWINGS"):
        corner = " AND " in name or not name.endswith(("HORIZONTAL", "VERTICAL"))
        return "+" if corner else "-" if name.endswith("HORIZONTAL") else "|"
    # It may be part of a name, which must not become another.
    return character.encode("ascii", "backslashreplace").decode()


codecs.register_error(ERRORS, _in_words)


def printable(text: str) -> str:
    """The text, or what stands for it on a standard output that can not show it."""
    encoding = getattr(sys.stdout, "encoding", None)
    try:
        return text.encode(encoding, ERRORS).decode(encoding) if encoding else text
    except LookupError:
        return text


def speak_plainly(stream: TextIO) -> None:
    """Make a stream write words for what it can not show, instead of failing."""
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors=ERRORS)


def is_unicode(stream: TextIO) -> bool:
    """Whether a stream can show everything."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "").startswith("utf")
