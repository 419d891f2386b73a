"""Pages in a real browser: what is read off them, what is switched, hostile names, and what they ask for."""

import hashlib
import json
import math
import re

import bench
import browser
import numpy as np
import pandas as pd
import pytest
from commands import run
from IPython.core.formatters import HTMLFormatter
from scipy.stats import chi2

import allanjax as aj

DEG_H = math.pi / 180 / 3600
HOSTILE = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked=2">{{ 7*7 }}\u2028$&'


@pytest.fixture(scope="module")
def chromium():
    with browser.browser() as started:
        yield started


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The page of a fit with its recording."""
    path = tmp_path_factory.mktemp("page") / "small.html"
    aj.report(bench.fit("small"), path, recording=bench.recording("small"))
    return path


def number(text: str) -> float:
    """A number as pages write it."""
    text = text.replace(",", "").replace("−", "-")
    mantissa, _, power = text.partition("×10")
    return float(mantissa) * 10.0 ** int(power.translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")) or 0)


def read(readout: str, name: str) -> list[float]:
    """Value and ends of the interval of an axis in a readout."""
    line = next(line for line in readout.splitlines() if name in line)
    found = re.search(r"measured (\S+) \S+ \(95 %: (\S+) … ([^)\s]+)\)", line)
    assert found, line
    return [number(text) for text in found.groups()]


def data_of(path) -> list:
    """The data of a page's charts."""
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])


def test_the_first_screen_has_verdict_table_and_curve_and_the_page_asks_for_nothing(chromium, shown):
    with browser.opened(chromium, shown) as tab:
        page = tab.page
        tab.chart("Gyros")
        for place in (".verdict", "table", "figure .u-over"):
            box = page.locator(place).first.bounding_box()
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= 800, place
        assert "fits" in page.locator(".verdict").inner_text()
        page.mouse.wheel(0, 100_000)
        page.wait_for_timeout(200)
        tab.check()
    # Three megabytes are for six axes; these are four.
    assert shown.stat().st_size < 2e6


def test_hovering_reads_time_value_interval_and_the_term_that_dominates(chromium, shown):
    fit = bench.fit("small")
    curve, k = fit.curve, fit.axes.index("gyro_y")
    # The scale is that of the cluster times, with a quarter more at each end.
    first, last = math.log(curve.cluster_time[0] / 1.25), math.log(curve.cluster_time[-1] * 1.25)
    with browser.opened(chromium, shown) as tab:
        plot = tab.chart("Gyros")
        for m in (0, 20, len(curve.cluster_time) - 5):
            time = curve.cluster_time[m]
            readout = plot.hover((math.log(time) - first) / (last - first))
            assert number(re.search(r"τ = (\S+) s", readout)[1]) == pytest.approx(time, rel=1e-3)
            # The interval by the χ² law of the variance.
            edf, value = curve.edf[m, k], curve.deviation[m, k] / DEG_H
            ends = [value * math.sqrt(edf / chi2.ppf(p, edf)) for p in (0.975, 0.025)]
            # Three digits are shown.
            assert read(readout, "gyro_y") == pytest.approx([value, *ends], rel=6e-3)
            # Closed forms (Hou 4.29–4.64) of the terms that were detected.
            c = {name: x.value for name, x in fit["gyro_y"].coefficients.items() if x.detected}
            powers = {
                "quantization": 3 * (c.get("quantization", 0) / time) ** 2,
                "angle random walk": c["angle_random_walk"] ** 2 / time,
                "rate random walk": c.get("rate_random_walk", 0) ** 2 * time / 3,
                "bias instability": (c.get("bias_instability", 0) * 0.664) ** 2,
            }
            largest = max(powers, key=powers.get)
            line = next(line for line in readout.splitlines() if "gyro_y" in line)
            assert f"mostly {largest}" in line
        tab.check()


def test_toggles_views_and_units_change_the_curves_they_name(chromium, shown):
    with browser.opened(chromium, shown) as tab:
        plot = tab.chart("Gyros")
        before = read(plot.hover(0.3), "gyro_y")
        plot.press("gyro_x")
        assert not plot.is_pressed("gyro_x")
        readout = plot.hover(0.3)
        assert "gyro_x" not in readout
        assert read(readout, "gyro_y") == before
        plot.press("model")
        assert "model" not in plot.hover(0.3)
        cell = tab.page.locator("tbody td").first
        usual = cell.inner_text()
        assert "deg/√h" in usual
        tab.page.get_by_role("button", name="SI units").click()
        assert "rad/√s" in cell.inner_text()
        line = next(line for line in plot.hover(0.3).splitlines() if "gyro_y" in line)
        value = number(re.search(r"(\S+) rad/s", line)[1])
        assert value == pytest.approx(before[0] * DEG_H, rel=6e-3)
        plot.press("PSD S(f)")
        assert "frequency f" in plot.hover(0.3)
        assert "(rad/s)²/Hz" in plot.readout
        tab.check()


def test_dragging_zooms_and_a_button_shows_all_again(chromium, shown):
    with browser.opened(chromium, shown) as tab:
        plot = tab.chart("Gyros")
        time = lambda share: number(re.search(r"τ = (\S+) s", plot.hover(share))[1])  # noqa: E731
        whole = time(0.05), time(0.95)
        plot.drag((0.4, 0.2), (0.6, 0.8))
        zoomed = time(0.05), time(0.95)
        assert whole[0] < zoomed[0] < zoomed[1] < whole[1]
        plot.press("Whole range")
        assert (time(0.05), time(0.95)) == whole
        tab.check()


def test_the_keyboard_alone_reads_zooms_and_switches(chromium, shown):
    times = bench.fit("small").curve.cluster_time
    with browser.opened(chromium, shown) as tab:
        keys = tab.page.keyboard
        plot = tab.chart("Gyros")
        # By Tab alone to the chart, which comes after the controls of the page and its own.
        for _ in range(40):
            keys.press("Tab")
            if tab.page.evaluate("document.activeElement.classList.contains('plot')"):
                break
        keys.press("Home")
        for _ in range(5):
            keys.press("ArrowRight")
        assert number(re.search(r"τ = (\S+) s", plot.readout)[1]) == pytest.approx(times[5], rel=1e-3)
        keys.press("+")
        keys.press("0")
        button = plot.figure.get_by_role("button", name="terms", exact=True)
        button.focus()
        keys.press("Enter")
        assert plot.is_pressed("terms")
        assert tab.page.evaluate("document.activeElement.textContent") == "terms"
        tab.check()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_follows_the_colours_of_the_system_and_can_be_switched(chromium, shown, scheme):
    brightness = (
        "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).reduce((a, b) => +a + +b) / 3"
    )
    with browser.opened(chromium, shown, color_scheme=scheme) as tab:
        assert (tab.page.evaluate(brightness) > 128) == (scheme == "light")
        tab.page.get_by_role("button", name="Dark").click()
        assert (tab.page.evaluate(brightness) > 128) == (scheme == "dark")
        tab.check()


def test_it_fits_the_width_of_a_phone(chromium, shown):
    with browser.opened(chromium, shown, viewport={"width": 390, "height": 844}) as tab:
        assert "gyro_y" in tab.chart("Gyros").hover(0.5)
        assert tab.page.evaluate("document.documentElement.scrollWidth") == 390
        tab.check()


def test_it_prints_all_of_it_on_white(chromium, shown, tmp_path):
    with browser.opened(chromium, shown, color_scheme="dark") as tab:
        tab.page.pdf(path=tmp_path / "page.pdf")
        tab.page.wait_for_timeout(300)
        assert tab.page.evaluate("[...document.querySelectorAll('details')].every(d => d.open)")
        tab.check()
    printed = (tmp_path / "page.pdf").read_bytes()
    assert printed.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) > 2


def test_hostile_names_are_shown_as_text(chromium, tmp_path):
    fit, recording = bench.fit("small"), bench.recording("small")
    named = {"name": HOSTILE, "notes": (*fit.notes, HOSTILE)}
    page = aj.report(
        aj.Fit(**vars(fit) | named), tmp_path / "hostile.html", title=HOSTILE, recording=recording
    )
    with browser.opened(chromium, tmp_path / "hostile.html") as tab:
        assert tab.page.locator("h1").inner_text().strip() == HOSTILE.replace("\u2028", " ").strip() or (
            tab.page.locator("h1").text_content() == HOSTILE
        )
        assert HOSTILE in tab.page.locator("main").text_content()
        assert tab.page.evaluate("window.hacked") is None
        assert tab.page.locator("main img").count() == 0
        tab.check()
    assert "49" not in re.findall(r"<h1>(.*?)</h1>", page.html)[0]


def test_the_policy_of_the_page_forbids_other_scripts_and_all_requests(chromium, shown):
    with browser.opened(chromium, shown) as tab:
        tab.page.evaluate(
            "() => { const s = document.createElement('script'); s.textContent = 'window.added = 1';"
            " document.body.append(s); }"
        )
        tab.page.evaluate("fetch('http://127.0.0.1:9/').catch(() => 0)")
        assert tab.page.evaluate("window.added") is None
        # The browser reports both, and no request was made.
        assert len(tab.complaints) >= 2
        assert tab.requests == [tab.address]


def test_a_single_extreme_sample_is_shown_however_long_the_record(tmp_path):
    x = np.random.default_rng(1).normal(size=(16_384, 1))
    x[7_001] = 40.0
    recording = aj.Recording.from_array(x, 100.0, gyro_unit="deg/s", names=["gyro_x"])
    aj.report(aj.fit(recording, "N", as_is=True), tmp_path / "spike.html", recording=recording)
    series = next(c for c in data_of(tmp_path / "spike.html") if "over time" in c["title"])["views"][0][
        "traces"
    ][0]
    highest = int(np.argmax(series["high"]))
    assert series["high"][highest] == pytest.approx((40.0 - x.mean()) * math.pi / 180, rel=1e-4)
    assert series["x"][highest] == pytest.approx(70.01, abs=163.84 / len(series["x"]))


def test_the_slider_reads_the_drift_at_its_horizon(chromium, shown):
    """Of independent second differences of the angle the deviation is √2·t·σ_A(t)."""
    fit = bench.fit("small")
    with browser.opened(chromium, shown) as tab:
        plot = tab.chart("Gyros: predicted drift")
        plot.figure.locator("input[type=range]").fill("20")
        line = next(line for line in plot.readout.splitlines() if "gyro_y" in line)
        time = number(re.search(r"horizon t = (\S+) s", plot.readout)[1])
        expected = math.sqrt(2) * time * float(fit.model_deviation("gyro_y", time)) * 180 / math.pi
        low, high = map(number, re.search(r"95 %: (\S+) … ([^)\s]+)\)", line).groups())
        # The mean over sets of terms that the data do not distinguish is near the model chosen.
        assert number(re.search(r"drift (\S+) deg", line)[1]) == pytest.approx(expected, rel=0.1)
        assert low < expected < high
        tab.check()


def test_exports_are_those_of_the_command_and_can_be_copied(chromium, shown):
    fit = bench.fit("small")
    with browser.opened(chromium, shown) as tab:
        exports = tab.page.locator(".exports")
        choice = exports.locator("select")
        names = choice.locator("option").all_inner_texts()
        name = next(name for name in names if "(kalibr)" in name)
        choice.select_option(label=name)
        visible = exports.locator("pre:visible")
        assert visible.text_content() == aj.export(fit, "kalibr")
        exports.get_by_role("button", name="Copy").click()
        exports.get_by_role("button", name="Copied").wait_for()
        assert len(names) > len(run("export", "--list").stdout.splitlines()) / 2
        tab.check()


@pytest.fixture
def thousand(tmp_path):
    """A fleet of a thousand units with a random walk each, of which two are far off."""
    values = np.exp(np.random.default_rng(5).normal(0.0, 0.02, 1000))
    values[[17, 600]] = 3.0
    names = [f"unit {k:04d}" for k in range(1000)]
    table = pd.DataFrame({"recording": names, "file": names, "value": values, "std": 0.01 * values})
    table = table.assign(lower_95=0.98 * values, upper_95=1.02 * values, upper_limit_95=np.nan, p_value=0.5)
    table = table.assign(
        group="", axis="gyro_x", sensor="gyro", coefficient="angle_random_walk", unit="deg/√h"
    )
    table = table.assign(terms="angle_random_walk", remarks="", warnings="", detected=True, measured=True)
    fleet = aj.FleetResult(table.assign(outlying=values > 2.0, ratio=values), (), (), 0)
    path = tmp_path / "fleet.html"
    aj.report(fleet, path, pages={"unit 0017": "recordings/unit%200017.html"})
    return path


def test_a_thousand_units_are_found_sorted_and_linked_without_as_many_rows(chromium, thousand):
    with browser.opened(chromium, thousand) as tab:
        table = tab.page.locator(".units")
        assert table.locator("tbody tr").count() == 100
        table.get_by_role("button", name="gyro_x N [deg/√h]").click()
        table.get_by_role("button", name="gyro_x N [deg/√h]").click()
        first = table.locator("tbody tr").first
        assert first.locator("td").nth(1).inner_text() == "3.00"
        table.get_by_role("searchbox").fill("0017")
        assert table.locator("tbody tr").count() == 1
        link = table.locator("a")
        assert (link.get_attribute("rel"), link.get_attribute("href")) == (
            "noopener",
            "recordings/unit%200017.html",
        )
        table.get_by_role("searchbox").fill("")
        table.get_by_role("button", name="Only marked").click()
        assert table.locator("tbody tr").all_inner_texts()[0].startswith("unit 0")
        assert table.locator("tbody tr").count() == 2
        tab.check()


def test_a_critiques_page_tells_each_finding_with_its_evidence(chromium, tmp_path):
    critique = bench.critique("line")
    aj.report(critique, tmp_path / "c.html")
    (finding,) = [f for f in critique.findings if f.cause == "sinusoid"]
    with browser.opened(chromium, tmp_path / "c.html") as tab:
        section = tab.page.locator(
            "section", has=tab.page.get_by_role("heading", name="What a simulation gets wrong")
        )
        assert str(finding) in section.locator("details").first.text_content().replace("\n", " ")
        assert section.locator("details figure").count() >= 1
        readout = tab.chart("record and 95 % of simulations").hover(0.5)
        assert "before" in readout
        assert "after" in readout
        tab.check()


def test_the_command_writes_one_page_for_several_files_with_their_hashes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        aj.write(bench.recording("white"), f"{name}.csv")
    done = run("report", "a.csv", "b.csv", "--quick", "--out", "both.html")
    assert done.exit_code == 0
    text = (tmp_path / "both.html").read_text(encoding="utf-8")
    for name in ("a", "b"):
        assert f"<h2>{name}: Result</h2>" in text
        assert hashlib.sha256((tmp_path / f"{name}.csv").read_bytes()).hexdigest() in text
    assert "allanjax" in text
    assert run("characterize", "a.csv", "--html", "--out", "r").exit_code == 0
    assert (tmp_path / "r" / "a.html").read_text(encoding="utf-8").count("<h2>") >= 6
    assert run("report", "r/a.json", "--out", "saved.html").exit_code == 0
    assert run("report", "a.csv", "--out", "page.pdf").exit_code == 2
    missing = run("report", "none.csv", "--out", "n.html")
    assert missing.exit_code == 1
    assert "none.csv" in missing.stderr


def test_a_page_is_shown_inline_in_a_notebook_and_saved_as_html_only(tmp_path):
    page = aj.report(bench.fit("white"))
    assert HTMLFormatter()(page).startswith("<iframe srcdoc=")
    with pytest.raises(aj.AllanjaxError, match=r"\.html"):
        page.save(tmp_path / "page.pdf")
    with pytest.raises(aj.AllanjaxError, match="nothing to report"):
        aj.report([])
