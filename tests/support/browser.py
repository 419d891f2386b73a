"""A real browser that opens pages from files, and notes what they ask for and complain about."""

import dataclasses
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

# Without these a browser looks for updates, which are no requests of the page.
_QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update")


def found() -> str:
    """Path of Chromium; skips the test if there is none."""
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(names)} is installed")
    return path


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=found(), args=list(_QUIET))
        yield chromium
        chromium.close()


@dataclasses.dataclass
class Tab:
    """An open page, and what went wrong in it."""

    page: Any
    address: str
    complaints: list[str]
    requests: list[str]

    def check(self) -> None:
        """Assert that there were no complaints, and no requests but for the page itself."""
        assert self.complaints == []
        assert self.requests == [self.address]

    def chart(self, title: str) -> "Plot":
        figure = self.page.locator("figure", has=self.page.locator("figcaption", has_text=title)).first
        figure.scroll_into_view_if_needed()
        figure.locator(".u-over").wait_for()
        return Plot(self.page, figure)


@dataclasses.dataclass
class Plot:
    """A chart of a page."""

    page: Any
    figure: Any

    @property
    def readout(self) -> str:
        return self.figure.locator(".readout").inner_text()

    def press(self, name: str) -> None:
        self.figure.get_by_role("button", name=name, exact=True).click()

    def is_pressed(self, name: str) -> bool:
        return (
            self.figure.get_by_role("button", name=name, exact=True).get_attribute("aria-pressed") == "true"
        )

    def hover(self, share: float) -> str:
        """Point at this share of the x axis, and return what is read there."""
        box = self.figure.locator(".u-over").bounding_box()
        self.page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
        return self.readout

    def drag(self, start: tuple[float, float], stop: tuple[float, float]) -> None:
        """Drag from one corner to another, in shares of the chart."""
        box = self.figure.locator(".u-over").bounding_box()
        points = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in (start, stop)]
        self.page.mouse.move(*points[0])
        self.page.mouse.down()
        self.page.mouse.move(*points[1], steps=5)
        self.page.mouse.up()


@contextmanager
def opened(chromium: Any, path: Path, **options: Any) -> Iterator[Tab]:
    """A page opened from a file, in a window of 1280 × 800 unless `options` say otherwise."""
    context = chromium.new_context(**{"viewport": {"width": 1280, "height": 800}} | options)
    page = context.new_page()
    tab = Tab(page, path.resolve().as_uri(), [], [])
    page.on("console", lambda message: tab.complaints.append(message.text))
    page.on("pageerror", lambda error: tab.complaints.append(str(error)))
    page.on("request", lambda request: tab.requests.append(request.url))
    page.goto(tab.address)
    yield tab
    context.close()
