"""`report`: results as one self-contained page of HTML."""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import html
import json
import math
import os
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.presentation.page.blocks import Chart, Section, Units

# Scripts and styles in the order in which the page has them.
_SCRIPTS, _STYLES = ("uPlot.iife.min.js", "page.js"), ("uPlot.min.css", "page.css")
# Significant digits of the numbers in a page: more than a screen or a hover shows.
_DIGITS = 5
# Height of a page in a notebook [pixels].
_NOTEBOOK_HEIGHT = 800


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Page(ByValue):
    """A page of HTML that needs no other file and no network.

    Attributes:
        title: its title.
        html: the document.
    """

    title: str
    html: str

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, and return its path.

        Raises:
            AllanjaxError: the file is named neither .html nor .htm.
        """
        path = Path(path)
        if path.suffix.lower() not in (".html", ".htm"):
            raise AllanjaxError(f"{str(path)!r}: a page is saved as .html")
        path.parent.mkdir(parents=True, exist_ok=True)
        # A name may come from a file name that is no text.
        path.write_text(self.html, encoding="utf-8", errors="backslashreplace")
        return path

    def _repr_html_(self) -> str:
        # In a frame of its own, without access to the notebook.
        document, title = html.escape(self.html), html.escape(self.title)
        return (
            f'<iframe srcdoc="{document}" sandbox="allow-scripts allow-popups allow-downloads" '
            f'title="{title}" style="width:100%;height:{_NOTEBOOK_HEIGHT}px;border:0"></iframe>'
        )

    def __repr__(self) -> str:
        return f"<Page {self.title!r}, {len(self.html) / 1e6:.2f} MB>"


def page_of(title: str, sections: Sequence[Section]) -> Page:
    """The page of these sections, the first of which is what one sees first."""
    scripts, styles = ([_asset(name) for name in names] for names in (_SCRIPTS, _STYLES))
    drawn: list[Chart | Units] = []

    def number(block: Chart | Units) -> int:
        """Number of the next block that the page's script draws."""
        drawn.append(block)
        return len(drawn) - 1

    text = _template().render(
        title=title,
        sections=sections,
        number=number,
        data=lambda: _as_json(drawn),
        scripts=scripts,
        styles=styles,
        policy=_policy(scripts, styles),
    )
    return Page(title, text)


@functools.cache
def _template() -> Any:
    """The template of all pages, which escapes every text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("allanjax.presentation.page", "assets")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html")


@functools.cache
def _asset(name: str) -> str:
    return files(__package__).joinpath("assets", name).read_text(encoding="utf-8")


def _policy(scripts: Sequence[str], styles: Sequence[str]) -> str:
    """Content-security policy that allows these scripts and styles by their hashes, and nothing else."""

    def hashes(texts: Sequence[str]) -> str:
        digests = (hashlib.sha256(text.encode()).digest() for text in texts)
        return " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)

    allowed = f"script-src {hashes(scripts)}; style-src {hashes(styles)}"
    return f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"


def _as_json(blocks: Sequence[Chart | Units]) -> str:
    """JSON that cannot end the element of the page that holds it."""
    text = json.dumps(blocks, default=_plain, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _plain(value: Any) -> Any:
    """Fields of a block, or numbers to a few digits, None for those that are not finite."""
    if isinstance(value, np.ndarray):
        return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in value.tolist()]
    return list(value) if isinstance(value, range) else vars(value)
