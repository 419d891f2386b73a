"""Text in ASCII for an output without Unicode: `deg/sqrt(h)`, `+-`, `tau`."""

import codecs
import io
import re
import sys
import unicodedata
from typing import TextIO

ERRORS = "allanjax"
"""Name of the error handler that writes these replacements, for `str.encode` and for streams."""

# Roots and raised digits, which are written as a whole, and single characters.
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
    """Replacement for characters that cannot be encoded, and the index at which to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text, at = error.object, error.start
    if root := _ROOT.match(text, at):
        return f"sqrt({root[1]})", root.end()
    if raised := _RAISED.match(text, at):
        return f"^{raised[0].translate(_LEVEL)}", raised.end()
    return _word(text[at]), at + 1


def _word(character: str) -> str:
    """ASCII replacement of one character."""
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
    """The text, with ASCII replacements for what the standard output cannot show."""
    encoding = getattr(sys.stdout, "encoding", None)
    try:
        return text.encode(encoding, ERRORS).decode(encoding) if encoding else text
    except LookupError:
        return text


def speak_plainly(stream: TextIO) -> None:
    """Make a stream write ASCII replacements for what it cannot show, instead of failing."""
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors=ERRORS)


def is_unicode(stream: TextIO) -> bool:
    """Whether a stream can show all of Unicode."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "").startswith("utf")
