"""A fit that was written to a file comes back as it was."""

import dataclasses
import json
import math
import re

import bench
import golden_records as golden
import numpy as np
import pytest
from altered_fits import without_result
from commands import schema
from dense_fits import recording
from refusals import refuses

import allanjax as aj
from allanjax.inspection.facts import Fact


def reloaded(fit, folder, **options):
    aj.write_json(fit, path := folder / "fit.json")
    schema("fit").validate(json.loads(path.read_text(encoding="utf-8")))
    return aj.load(path, **options)


def white(axes=2, **auxiliary):
    x = 1e-3 * np.random.default_rng(5).standard_normal((2048, axes))
    return recording(x, 100.0, "deg/s", **auxiliary)


def far_off():
    """One axis under a line, one at rest, one dead."""
    x = np.random.default_rng(6).standard_normal((2048, 3)) * [1.0, 1.0, 0.0]
    x[:, 0] += 3.0 * np.sin(2.0 * np.pi * 3.0 * np.arange(2048) / 100.0)
    whole = aj.Recording.from_array(x, 100.0, gyro_unit="deg/s", name="bench")
    return aj.fit(whole, "N + K", as_is=True, vibrating=True)


def with_regressor():
    """Of the spectrum, with a held time and a regressor."""
    record = white(axes=1, temperature=np.sin(np.arange(2048) / 900.0))
    model = aj.AngleRandomWalk() + aj.Markov().hold(correlation_time=3.0)
    return aj.fit(record, model, "whittle", regressors=["temperature"])


def not_finite():
    """As if numbers had not been determined."""
    fit = aj.fit(white(), "N + K")
    first = dataclasses.replace(fit.results[0], chi2=math.nan, p_value=math.nan, mean=math.nan)
    return dataclasses.replace(fit, results=(first, *fit.results[1:]))


def failed():
    fit = without_result(aj.fit(white(), "N + K"), "gyro_0")
    moved = Fact("at rest", "it was moved", ("gyro_0",), "not a measurement", 3.0, "deg/s", ((1.5, 19.0),))
    told = Fact("length", "short", (), meaning="B and K are not known", remedy="record longer")
    assert told.text == "short; B and K are not known; record longer"
    facts = (moved, told)
    return dataclasses.replace(fit, facts=facts, parts=((1.5, 9.0), (10.0, 19.0)))


FITS = {
    "chosen": lambda: bench.fit("small"),
    "corrected": lambda: bench.fit("filtered"),
    "order": lambda: bench.fit("butterworth", "butterworth(order=4) * (N + K)", "whittle"),
    "whittle": with_regressor,
    "exact": lambda: aj.fit(white(), "N + K", "exact"),
    "wavelet": lambda: aj.fit(white(), "N + K", "wavelet"),
    "ramp and line": lambda: aj.fit(white(), "N + R + sinusoid(frequency=7 Hz)", "whittle"),
    "far off": far_off,
    "failed": failed,
    "not finite": not_finite,
    "missing": lambda: bench.fit("lossy"),
    "stretches": lambda: bench.fit("stretches"),
}


@pytest.mark.parametrize("kind", FITS)
def test_it_says_and_holds_the_same(kind, tmp_path):
    fit = FITS[kind]()
    again = reloaded(fit, tmp_path)
    assert again == fit
    assert again.to_dict() == fit.to_dict() == aj.to_dict(fit)
    json.dumps(fit.to_dict(), allow_nan=False)
    assert str(again) == str(fit)
    for result, other in zip(fit.results, again.results, strict=True):
        for name in ("correction", "measured", "verdict"):
            assert getattr(other, name) == getattr(result, name), name


@pytest.mark.filterwarnings("ignore::allanjax.PosteriorWarning")
def test_what_follows_from_it_is_the_same(tmp_path):
    """Posteriors of Allan variances; of a spectrum there is nothing to sample any more."""
    fit = bench.fit("small")
    again = reloaded(fit, tmp_path)
    one, other = (aj.sample(f, "gyro_x", max_steps=20, progress=False)["gyro_x"] for f in (fit, again))
    np.testing.assert_allclose(other.chain, one.chain, rtol=1e-9)
    with pytest.raises(aj.FitError, match="spectrum"):
        aj.sample(reloaded(with_regressor(), tmp_path))


class Half(aj.NoiseTerm):
    """A slope between random walk and flicker: S(f) ∝ f^(−1/2)."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * lag**1.5 / 2


def test_a_term_of_ones_own_is_fitted_and_asked_for(tmp_path):
    """Drawn as a sum of Gauss–Markov processes: of a power law of exponent ½."""
    rng, density = np.random.default_rng(11), 1e-5
    x = golden.white(rng, 16_384, 1e-3) + golden.power_law(rng, 16_384, density, 0.5)
    fit = aj.fit(recording(x, 100.0), aj.AngleRandomWalk() + Half(), as_is=True, vibrating=True)
    # G = −A²(2π)^½ t^1.5/(2Γ(2.5)cos(π/4)).
    c, truth = fit["gyro_0"]["half"], np.sqrt(density * np.sqrt(2.0 * np.pi) / (1.32934 * np.sqrt(0.5)))
    assert c.detected
    assert abs(c.value - truth) < 4.0 * c.std
    refuses(r"half.*terms=", reloaded, fit, tmp_path)
    again = reloaded(fit, tmp_path, terms=[Half])
    assert aj.to_dict(again) == aj.to_dict(fit)
    assert again["gyro_0"]["half"] == c


def test_files_of_several_fits(tmp_path):
    fits = {"a.csv": bench.fit("small"), "b.csv": failed()}
    entries = [{"file": name, **aj.to_dict(fit)} for name, fit in fits.items()]
    path = tmp_path / "fits.json"
    path.write_text(json.dumps({"schema_version": 1, "fits": entries, "errors": []}), encoding="utf-8")
    found = aj.load(path)
    assert {name: fit.converged for name, fit in found.items()} == {"a.csv": True, "b.csv": False}
    path.write_text(json.dumps({"key": {}, "fit": entries[0]}), encoding="utf-8")
    assert str(aj.load(path)) == str(fits["a.csv"])


CHANGES = {
    "curve": lambda d: d.pop("curve"),
    "schema version 2": lambda d: d.update(schema_version=2),
    "not a fit": lambda d: d.pop("axes"),
    "'si'": lambda d: d["axes"][0]["coefficients"][0].pop("si"),
    "damaged": lambda d: d["curve"]["deviation"].pop("gyro_y"),
}


def test_what_is_no_fit_is_refused(tmp_path):
    path = tmp_path / "fit.json"
    for word, change in CHANGES.items():
        document = aj.to_dict(bench.fit("small"))
        change(document)
        path.write_text(json.dumps(document), encoding="utf-8")
        refuses(f"(?s)^{re.escape(str(path))}: .*{word}", aj.load, path)
    for text in ("{", "[1, 2]", "3", '{"rows": []}', ""):
        path.write_text(text, encoding="utf-8")
        refuses(r"fit\.json", aj.load, path)
    refuses(r"y\.json", aj.load, tmp_path / "y.json")
