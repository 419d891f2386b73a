"""All public results: mappings, equal by value, pickled, told in short, with frames and JSON."""

import copy
import dataclasses
import functools
import json
import os
import pickle
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Mapping

import bench
import jax
import numpy as np
import pandas as pd
import pytest
from turned_sensors import at_rest

import allanjax as aj

NAMES = ["gyro_x", "gyro_y", "gyro_z", "accel_z"]
WALKING = {"gyro_x": "N=0.1 deg/√h + K=1 deg/h/√h", "accel_x": "N=0.05 m/s/√h"}


def recording():
    small = bench.recording("small")
    return dataclasses.replace(small, auxiliary={"temperature": small.time})


def short():
    return bench.recording("small")["gyro_x", "accel_z"].between(0.0, 5.12)


def accumulated():
    accumulator = aj.AllanAccumulator(100.0, ["gyro_x"])
    accumulator.update(bench.recording("small").values[:, :1])
    return accumulator


def calibrated():
    records = {way: at_rest([x], 64, 10.0, axes="z") for way, x in (("z up", 9.81), ("z down", -9.79))}
    return aj.calibrate(records, gravity=9.8, model="N=0.01 m/s/√h", as_is=True)


def fit():
    return bench.fit("small")


def posterior():
    return bench.posterior("small", ("gyro_x", "accel_z"))


@functools.cache
def rates():
    curve = aj.allan_deviation(bench.recording("white").values[:1024, 0], 50.0, gyro_unit="rad/s")
    none = np.full(1, np.nan)
    axis = aj.Axis("gyro", "gyro", "rad/s")
    one = aj.AxisRates(axis, np.array([50.0]), none, none, none, np.full((1, 2), np.nan), none, None, None)
    return aj.SampleRates("white", (curve,), (curve,), (one,))


#: Results of several axes, with the axes' names.
BY_AXIS = {
    "Fit": (fit, NAMES),
    "TermSelection": (lambda: fit().selection, NAMES),
    "Posterior": (posterior, ["gyro_x", "accel_z"]),
    "Critique": (lambda: bench.critique("steps"), ["gyro_x", "accel_x"]),
    "Horizon": (lambda: aj.horizon(fit(), 10.0, axes=["gyro_y", "accel_z"]), ["gyro_y", "accel_z"]),
    "Filtered": (lambda: aj.kalman_filter(short(), fit()), ["gyro_x", "accel_z"]),
    "Alignment": (lambda: aj.align(WALKING, 45.0, rate=10.0), ["gyro_x", "accel_x"]),
    "SampleRates": (rates, ["gyro"]),
    "Calibration": (calibrated, ["accel_z"]),
}
#: Others, and parts of those.
MORE = {
    "Recording": recording,
    "PowerSpectrum": lambda: aj.power_spectrum(recording()),
    "Autocorrelation": lambda: aj.autocorrelation(recording(), longest_lag=1.0),
    "WaveletVariance": lambda: aj.wavelet_variance(recording()),
    "WaveletDecomposition": lambda: aj.wavelet_decomposition(short(), levels=2),
    "Check": lambda: aj.check(bench.recording("small")),
    "Navigation": lambda: aj.navigate(WALKING, [1.0, 5.0], rate=10.0),
    "ErrorGrowth": lambda: aj.navigate(WALKING, [1.0, 5.0], rate=10.0)["attitude"],
    "Finding": lambda: bench.critique("steps").findings[0],
    "Estimate": lambda: fit()["gyro_x"]["bias_instability"],
    "Drift": lambda: posterior()["gyro_x"].predicted_drift()[60.0],
    "Markov": lambda: aj.Markov(correlation_time=3.0).hold("correlation_time"),
    "StateSpace": lambda: fit()["accel_z"].model.state_space(100.0),
    "FleetResult": lambda: aj.FleetResult(fit().to_dataframe(), (), (), 0),
    "AllanAccumulator": accumulated,
}
MORE |= {"AllanDeviation": lambda: fit().curve, "TermSet": lambda: fit().selection["gyro_x"].best}
MORE |= {"Denoised": lambda: aj.denoise(short(), fit()), "Inspection": lambda: aj.inspect(recording())}
MORE |= {"Axis": lambda: recording().axes[0], "Model": lambda: fit()["gyro_x"].model}
MORE |= {"DataSheet": lambda: aj.datasheet(aj.datasheets()[0]), "SensorPreset": lambda: aj.SENSORS["hg1700"]}
MORE |= {"LogUniform": lambda: aj.LogUniform(1e-6, 1e-3)}
ALL = MORE | {name: make for name, (make, _) in BY_AXIS.items()}
ALL |= {f"axis of {name}": lambda m=make, n=names[0]: m()[n] for name, (make, names) in BY_AXIS.items()}


@pytest.mark.parametrize("kind", BY_AXIS)
def test_results_of_axes_are_mappings(kind):
    make, names = BY_AXIS[kind]
    results = make()
    assert isinstance(results, Mapping)
    assert list(results) == list(results.keys()) == list(results.axes) == names
    assert (len(results), tuple(results.values())) == (len(names), results.results)
    for name, result in zip(names, results.results, strict=True):
        assert result.axis.name == name
        assert results[name] is results.get(name) is result
        assert name in results
    assert "mag_x" not in results
    assert results.get("mag_x", results) is results
    with pytest.raises(aj.AllanjaxError, match=f"has no axis 'mag_x'; it has {', '.join(names)}$"):
        results["mag_x"]
    for told in (str(results), repr(results)):
        assert all(name in told for name in names)


TABLES = {*BY_AXIS, "FleetResult", "Navigation", "Check", "Inspection", "Denoised", "DataSheet"}
TABLES |= {"SensorPreset", "axis of Critique", "axis of Calibration"}


@pytest.mark.parametrize("kind", ALL)
def test_copies_are_equal_and_what_is_told_is_short(kind):
    result = ALL[kind]()
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert bool(other == result)
        if kind not in ("AllanAccumulator", "StateSpace"):
            assert hash(other) == hash(result)
    assert result != 3
    if kind not in TABLES:
        assert len(repr(result).splitlines()) <= 2
        assert len(repr(result)) < 500
        assert "array(" not in repr(result)


def but(make, **changes):
    return make, lambda one: dataclasses.replace(one, **{k: change(one) for k, change in changes.items()})


CHANGES = {
    "a sample": but(recording, values=lambda r: r.values + 1e-12 * (r.values == r.values[-1, -1])),
    "a name": but(recording, name=lambda r: "other"),
    "a channel": but(recording, auxiliary=lambda r: {"temperature": r.time + 1e-9}),
    "no channel": but(recording, auxiliary=lambda r: {}),
    "an edf": but(ALL["AllanDeviation"], edf=lambda c: c.edf * (1.0 + 1e-12 * (c.edf > 9.0))),
    "a shape": but(ALL["AllanDeviation"], deviation=lambda c: c.deviation[:, :1], edf=lambda c: c.edf[:, :1]),
    "an end": but(ALL["Estimate"], interval=lambda e: (e.interval[0], e.interval[1] * 1.0001)),
    "a limit": but(ALL["Estimate"], upper_limit=lambda e: 1.0),
    "a prior": (lambda: aj.Uniform(0.0, 1.0), lambda p: aj.Uniform(0.0, 2.0)),
    "its kind": (lambda: aj.Uniform(1.0, 2.0), lambda p: aj.LogUniform(1.0, 2.0)),
    "a row": but(ALL["FleetResult"], table=lambda f: f.table.iloc[:-1]),
    "a term": (lambda: aj.Model((aj.Markov(1.0, 2.0),)), lambda m: aj.Model((aj.Markov(1.0, 2.5),))),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_differs_in_one_number_is_not_equal(what):
    make, change = CHANGES[what]
    one, other = make(), change(make())
    assert (one == other) is (other == one) is False
    assert one != other
    assert len({one, other, copy.deepcopy(one)}) == 2


def test_a_fit_prints_a_row_per_axis_and_all_coefficients_in_details():
    lines = str(fit()).splitlines()
    assert max(map(len, lines)) <= 100
    for name, result in fit().items():
        (row,) = (line for line in lines if line.startswith(name) and line.endswith(result.word))
        basic = [c.in_unit() for c in result.coefficients.values() if c.symbol in "NBK"]
        assert row.count("±") == sum(c.detected for c in basic)
        assert row.count("<") == sum(not c.detected for c in basic)
        rows = str(result).splitlines()
        for c in (c for c in basic if c.detected):
            assert any(c.title in line and c.describe() in line for line in rows)


def test_the_frame_of_a_fit_is_that_of_its_axes_and_a_finding_is_an_estimate():
    whole = pd.concat([result.to_dataframe() for result in fit().results], ignore_index=True)
    pd.testing.assert_frame_equal(whole, fit().to_dataframe())
    time = ALL["Finding"]().parameters["time"]
    assert (time.source, time.axis.name) == ("critique", "gyro_x")
    minutes = time.in_unit("min")
    assert [minutes.value, minutes.std] == pytest.approx([time.value / 60.0, time.std / 60.0])


@pytest.mark.parametrize("kind", sorted(set(BY_AXIS) - {"TermSelection", "Posterior"}))
def test_documents_are_json_and_name_their_axes(kind):
    result = BY_AXIS[kind][0]()
    told = aj.to_dict(result) if kind == "Fit" else result.to_dict()
    document = json.loads(json.dumps(told, allow_nan=False))
    axes = document.get("axes") or document["parameters"]
    assert {axis.get("name", axis.get("axis")) for axis in axes} == set(result.axes)


posix = pytest.mark.skipif(os.name != "posix", reason="elsewhere each user has temporary files of their own")


@pytest.fixture
def told(monkeypatch, tmp_path):
    """What JAX was told, in a folder with a home that cannot be written to: it is a file."""
    found = {}
    monkeypatch.setattr(jax.config, "update", found.__setitem__)
    monkeypatch.chdir(tmp_path)
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ALLANJAX_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is a convention of Linux")
def test_it_is_nowhere_or_where_it_is_said_to_be_or_the_users(told, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("ALLANJAX_CACHE", "OFF")
    assert aj.enable_compilation_cache() is None
    assert (told, list((tmp_path / "home").iterdir())) == ({}, [])
    for said, expected in ((str(tmp_path / "by name"), "by name"), ("", "home/allanjax/jax")):
        monkeypatch.setenv("ALLANJAX_CACHE", said)
        folder = aj.enable_compilation_cache()
        assert (folder, folder.is_dir()) == (tmp_path / expected, True)
        assert told["jax_compilation_cache_dir"] == str(folder)
        assert told["jax_persistent_cache_min_compile_time_secs"] == 0.0
    assert aj.enable_compilation_cache(tmp_path / "given") == tmp_path / "given"


@posix
def test_a_home_that_cannot_be_written_to_is_nobodys_mistake(told, monkeypatch, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = aj.enable_compilation_cache()
        assert folder.parent == tmp_path / "temporary"
        assert told["jax_compilation_cache_dir"] == str(folder)
        assert aj.enable_compilation_cache() == folder
    # A folder that was asked for is another matter.
    monkeypatch.setenv("ALLANJAX_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="ALLANJAX_CACHE"):
        assert aj.enable_compilation_cache() is None


@posix
@pytest.mark.parametrize("what", ["writable by others", "somebody else's", "a link", "a file"])
def test_programs_that_another_may_have_written_are_not_used(told, monkeypatch, tmp_path, what):
    uid = os.getuid() + (what == "somebody else's")
    monkeypatch.setattr(os, "getuid", lambda: uid)
    folder = tmp_path / "temporary" / f"allanjax-{uid}"
    if what == "a link":
        folder.symlink_to(tmp_path / "home")
    elif what == "a file":
        folder.write_text("")
    else:
        folder.mkdir()
        folder.chmod(0o777 if what == "writable by others" else 0o700)
    assert aj.enable_compilation_cache() is None
    assert told == {}


PROGRAM = """
import sys
from collections import Counter
from jax import monitoring
seen = Counter()
monitoring.register_event_listener(lambda event, **_: seen.update([event.rpartition("/")[2]]))
from allanjax.cli.app import run
run("simulate --terms N=1deg/√h+K=1deg/h/√h --duration 60 --out a.csv".split())
print(seen["compile_requests_use_cache"], seen["cache_hits"])
"""


@pytest.mark.study
@pytest.mark.skipif(sys.platform != "linux", reason="where home and temporary files are")
def test_commands_find_all_that_an_earlier_one_compiled_also_without_a_home(told, tmp_path):
    environment = os.environ | {"HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "temporary")}
    for name in ("ALLANJAX_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    counts = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, stdout=-1, check=True)
        counts.append(tuple(map(int, done.stdout.split()[-2:])))
    (asked, hits), again = counts
    assert asked > hits
    assert again == (asked, asked)
