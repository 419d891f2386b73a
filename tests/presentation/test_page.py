"""Pages in a real browser: what is read off them, what is switched, hostile names, and what they ask for."""

import dataclasses
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
        head, cell = (tab.page.locator(f"tbody {kind}").first for kind in ("th", "td"))
        assert "deg/√h" in head.inner_text()
        usual = number(cell.inner_text().split(" ± ")[0])
        tab.page.get_by_role("button", name="SI units").click()
        assert "rad/√s" in head.inner_text()
        mantissa, power = re.search(r"\((\S+) ± \S+\)(×10\S+)", cell.inner_text()).groups()
        # A degree per root hour is π/180/60 rad/√s; three digits are shown.
        assert number(mantissa + power) == pytest.approx(usual * math.pi / 180 / 60, rel=2e-3)
        line = next(line for line in plot.hover(0.3).splitlines() if "gyro_y" in line)
        value = number(re.search(r"(\S+) rad/s", line)[1])
        assert value == pytest.approx(before[0] * DEG_H, rel=6e-3)
        plot = tab.chart("Gyros: power spectral density")
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


def six() -> aj.Recording:
    """White noise on six axes, 0.3 deg/√h and 0.05 m/s/√h, and a line on gyro_y with 1.7 times its power."""
    rng, rate, n = np.random.default_rng(3), 100.0, 30_000
    white = math.sqrt(rate / 3600) * np.repeat([0.3, 0.05], 3)
    x = white * rng.normal(size=(n, 6))
    x[:, 1] += math.sqrt(2 * 1.7) * white[1] * np.sin(2 * math.pi * 17.3 / rate * np.arange(n))
    names = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    return aj.Recording.from_array(x, rate, gyro_unit="deg/s", accel_unit="m/s²", names=names, name="six")


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """A page as a laboratory hands it out: six axes, one with a line, limits, conditions and a title."""
    recording = six()
    critique = bench.once("critique of six axes", lambda: aj.critique(recording))
    known = {"begun": 1.7e9, "auxiliary": {"temperature": np.linspace(24.0, 25.5, recording.n)}}
    recording = dataclasses.replace(recording, auxiliary_units={"temperature": "degC"}, **known)
    path = tmp_path_factory.mktemp("document") / "six.html"
    more = {"title": "Unit 0123", "notes": {"serial number": "0123", "operator": "A. Smith"}}
    limits = {"name": "AT-7", "gyro": {"meaning": "maximum", "N": "0.2 deg/√h", "K": "400 deg/h/√h"}}
    aj.report(aj.fit(recording), path, critique=critique, recording=recording, spec=limits, **more)
    return path


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_no_text_lies_on_another_and_no_cell_is_cut(chromium, document, width):
    with browser.opened(chromium, document, viewport={"width": width, "height": 800}) as tab:
        tab.see_all()
        found = tab.laid_out()
        assert found.pop("count") > 400
        assert found == {"over": [], "cut": [], "beyond": 0}
        tab.check()


def test_the_measure_of_the_layout_sees_what_overlaps_and_is_cut(chromium, document):
    with browser.opened(chromium, document) as tab:
        tab.chart("Gyros")
        tab.page.evaluate("document.querySelector('td').style.width = 0")
        tab.page.evaluate("document.querySelector('.verdict').style.marginBottom = '-2rem'")
        tab.page.evaluate("document.querySelector('canvas').getContext('2d').fillText('minimum', -20, 60)")
        found = tab.laid_out()
        assert any("AT-7" in pair for pair in found["over"])
        assert "minimum" in found["cut"]


def test_it_prints_on_two_or_three_sheets_with_a_legend(chromium, document, tmp_path):
    with browser.opened(chromium, document, color_scheme="dark") as tab:
        tab.page.pdf(path=tmp_path / "page.pdf", format="A4")
        printed = (tmp_path / "page.pdf").read_bytes()
        assert printed.startswith(b"%PDF")
        assert len(re.findall(rb"/Type\s*/Page\b", printed)) in (2, 3)
        # The same on the screen: 190 mm of paper are 718 pixels.
        tab.page.set_viewport_size({"width": 718, "height": 1000})
        tab.page.emulate_media(media="print")
        tab.page.evaluate("dispatchEvent(new Event('beforeprint'))")
        tab.page.wait_for_timeout(200)
        found = tab.laid_out()
        assert found.pop("count") > 200
        assert found == {"over": [], "cut": [], "beyond": 0}
        shown = tab.page.locator("figure", has_text="Gyros").first.locator(".controls button:visible")
        # Only what is drawn, and no button that does something.
        assert shown.all_inner_texts() == ["gyro_x", "gyro_y", "gyro_z", "model", "measured"]
        colours = {button.evaluate("b => getComputedStyle(b).color") for button in shown.all()[:3]}
        assert len(colours) == 3
        text = tab.page.locator("body").inner_text()
        assert "IEEE Std 952" in text
        assert "two-sided density N²" in text
        assert "Copy CSV" not in text
        tab.check()


def test_marks_are_those_of_one_axis(chromium, document):
    written = (
        "document.querySelector('canvas').written.map(([text]) => text).filter(t => t.includes('at 1 s'))"
    )
    with browser.opened(chromium, document) as tab:
        plot = tab.chart("Gyros")
        marks = plot.figure.get_by_role("button", name="marks", exact=True)
        assert tab.page.evaluate(written) == ["N at 1 s"]
        assert marks.get_attribute("title") == "of gyro_x"
        plot.press("gyro_z")
        plot.press("gyro_z")
        assert tab.page.evaluate(written) == ["N at 1 s"]
        assert marks.get_attribute("title") == "of gyro_z"
        tab.check()


def test_what_was_found_is_said_in_words_with_limits_and_conditions(chromium, document):
    with browser.opened(chromium, document) as tab:
        assert tab.page.locator("h1").inner_text() == "Unit 0123"
        section = tab.page.locator("section").first
        limits, found = section.locator(".verdict").all_inner_texts()
        # The truth, see `six`: 1.7 times the power of the white noise.
        assert re.fullmatch(
            r"One disturbance: a spectral line at 17\.3\d* Hz on gyro_y, 1\.[67]\d* times its noise power\.",
            found,
        )
        assert limits == "AT-7: fail, N of gyro_x, gyro_y and gyro_z."
        text = section.inner_text()
        assert "nats" not in text
        assert "Good" not in text
        for told in ("serial number: 0123", "operator: A. Smith", "start: 2023-11-14 22:13:20 UTC"):
            assert told in text
        assert "temperature [degC]: 24 … 25.5" in text
        table = tab.page.locator("section", has=tab.page.get_by_role("heading", name="Limits"))
        rows = table.locator("tbody tr")
        assert rows.count() == 6
        # N of 0.3 deg/√h is 50 % above 0.2.
        value, low, high = map(
            float, re.search(r"(-\d+) % \((-\d+) … (-\d+)\)", rows.first.inner_text()).groups()
        )
        assert value == pytest.approx(-50.0, abs=3.0)
        assert low <= value <= high


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
    table = table.assign(unit_name=names, odd_record=False, record_ratio=np.nan)
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
        assert "without it" in readout
        assert "with all findings" in readout
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
    said = ["--title", "Unit 7", "--note", "serial number=0007", "--note", "operator=A. Smith"]
    # White noise of 0.1 deg/√h: one limit is met, the other is not.
    for limit, code in (("1 deg/√h", 0), ("0.01 deg/√h", 1)):
        (tmp_path / "limits.yaml").write_text(f"gyro: {{meaning: maximum, N: {limit}}}", encoding="utf-8")
        done = run("report", "r/a.json", "--spec", "limits.yaml", *said, "--out", "told.html")
        assert done.exit_code == code, done.stderr
        told = (tmp_path / "told.html").read_text(encoding="utf-8")
        assert "<h1>Unit 7</h1>" in told
        assert "serial number: 0007 · operator: A. Smith" in told
        assert ("all limits are met" in told) == (code == 0)
    assert run("report", "r/a.json", "--note", "serial number").exit_code == 2
    assert run("report", "r/a.json", "--spec", "none.yaml").exit_code == 1
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
