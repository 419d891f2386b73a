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


# Notes every text that is drawn on a canvas, with its box, until the canvas is cleared.
_NOTE = """(() => {
  const {fillText, clearRect} = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.clearRect = function (x, y, w, h) {
    if (w >= 0.9 * this.canvas.width) this.canvas.written = [];
    clearRect.call(this, x, y, w, h);
  };
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
    const m = this.measureText(text), t = this.getTransform();
    const ends = [
      [x - m.actualBoundingBoxLeft, y - m.actualBoundingBoxAscent],
      [x + m.actualBoundingBoxRight, y + m.actualBoundingBoxDescent],
    ].map(end => t.transformPoint(new DOMPoint(...end)));
    (this.canvas.written ||= []).push([text, ends]);
    fillText.call(this, text, x, y);
  };
})()"""
# Texts that overlap, on canvases and elsewhere, and cells and others that are cut or leave their section.
_MEASURE = """() => {
  const texts = [], cut = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; node = walker.nextNode();) {
    const e = node.parentElement, range = document.createRange();
    if (!node.textContent.trim() || !e.checkVisibility() || e.closest("script, style, select, pre")) continue;
    range.selectNodeContents(node);
    // A line is higher than its letters.
    for (const {left, right, top, bottom, height} of range.getClientRects())
      texts.push([node.textContent.trim(), left, right, top + 0.2 * height, bottom - 0.2 * height]);
  }
  for (const canvas of document.querySelectorAll("canvas")) {
    const box = canvas.getBoundingClientRect(), k = box.width / canvas.width;
    for (const [text, [p, q]] of canvas.written || []) {
      if (!text || !canvas.checkVisibility()) continue;
      const [x, y] = [[p.x, q.x], [p.y, q.y]].map(ends => ends.sort((a, b) => a - b).map(v => k * v));
      texts.push([text, box.left + x[0], box.left + x[1], box.top + y[0], box.top + y[1]]);
      if (x[0] < -0.5 || y[0] < -0.5 || x[1] > box.width + 0.5 || y[1] > box.height + 0.5) cut.push(text);
    }
  }
  const over = texts.flatMap((a, k) => texts.slice(k + 1)
    .filter(b => a[1] < b[2] - 0.5 && b[1] < a[2] - 0.5 && a[3] < b[4] - 0.5 && b[3] < a[4] - 0.5)
    .map(b => `${a[0]} | ${b[0]}`));
  const boxes = "td, th, p, button, h1, h2, summary, figcaption, caption, table";
  for (const e of document.querySelectorAll(boxes)) {
    if (!e.checkVisibility() || e.closest(".units")) continue;
    const box = e.getBoundingClientRect(), about = e.closest("section, header, body").getBoundingClientRect();
    const beyond = box.right > about.right + 1 || box.left < about.left - 1;
    if (e.scrollWidth > e.clientWidth + 1 || beyond) cut.push(e.textContent.trim());
  }
  return {count: texts.length, over, cut, beyond: document.documentElement.scrollWidth - innerWidth};
}"""


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

    def see_all(self) -> None:
        """Scroll through the page, so that all charts are drawn."""
        height = self.page.evaluate("document.documentElement.scrollHeight")
        for place in range(0, height, 400):
            self.page.evaluate(f"scrollTo(0, {place})")
            self.page.wait_for_timeout(30)
        self.page.evaluate("scrollTo(0, 0)")

    def laid_out(self) -> dict[str, Any]:
        """How many texts there are, which overlap, which are cut, and how far the page exceeds the window."""
        return self.page.evaluate(_MEASURE)

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
        # A chart is drawn when it comes into view, and then is larger.
        self.figure.locator(".u-over").scroll_into_view_if_needed()
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
    page.add_init_script(_NOTE)
    tab = Tab(page, path.resolve().as_uri(), [], [])
    page.on("console", lambda message: tab.complaints.append(message.text))
    page.on("pageerror", lambda error: tab.complaints.append(str(error)))
    page.on("request", lambda request: tab.requests.append(request.url))
    page.goto(tab.address)
    yield tab
    context.close()
