"""How much N varies over a record is measured, widens its interval, and is nothing else's business."""

import json

import numpy as np
import pytest

import allanjax as aj

RATE, N = 100.0, 65_536
TIME = np.arange(N) / RATE
AXES = ("gyro_x", "gyro_y", "gyro_z")
WHITE, WALK = 1e-3, 2e-6


def recording(amplitude, seed, draw="standard_normal", walk=WALK):
    """Three axes of white noise of varying amplitude [n] and a random walk."""
    rng = np.random.default_rng(seed)
    white = getattr(rng, draw)(*((5.0,) if draw == "standard_t" else ()), size=(N, 3))
    white /= np.sqrt(5.0 / 3.0) if draw == "standard_t" else 1.0
    x = WHITE * np.sqrt(RATE) * amplitude[:, None] * white
    x += walk * np.cumsum(rng.standard_normal((N, 3)), axis=0)
    return aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=list(AXES))


def course(kind):
    """Amplitude of the noise over the record, relative to about its mean."""
    if kind == "step":
        return np.where(TIME < 200.0, 1.0, 1.05)
    if kind == "louder tenth":
        return np.where((TIME > 300.0) & (TIME < 365.5), 1.3, 1.0)
    if kind == "sinusoid":
        return 1.0 + 0.03 * np.sin(2.0 * np.pi * TIME / 300.0)
    steps = np.random.default_rng(9).standard_normal(N)
    walk = 0.05 * np.cumsum(steps) / np.sqrt(N)
    return 1.0 + walk - walk.mean()


@pytest.mark.parametrize("kind", ["step", "louder tenth", "sinusoid", "walk"])
def test_the_size_of_a_variation_is_told_and_the_mean_is_covered(kind):
    """Of 65,536 samples a window of 1,024 determines N to 2.2 %, and the scatter of 64 to 0.3 % of N."""
    amplitude = course(kind)
    size, mean = np.std(amplitude), np.sqrt(np.mean(amplitude**2))
    found = [r["N"] for seed in (1, 2) for r in aj.fit(recording(amplitude, seed), "N + K").results]
    sizes = np.array([c.variation.size for c in found])
    # The mean of six sizes, each of which scatters by 0.3 % of N, or by a sixth if it is large.
    assert sizes.mean() == pytest.approx(size, rel=0.1, abs=0.003)
    inside = [low <= size <= high for low, high in (c.variation.interval for c in found)]
    assert sum(inside) >= 4
    for c in found:
        # The error of the mean of this record, 0.28 %, is in the interval, and more.
        assert c.interval[0] <= WHITE * mean <= c.interval[1]
        if kind in ("step", "walk"):
            # What is slow may go on in another record as long.
            assert c.std > 1.5 * WHITE * mean / np.sqrt(2.0 * N)
        assert "varies by" in str(c.variation)


@pytest.mark.parametrize("kind", ["Gaussian", "heavy tails", "rounded", "lines that vary", "slow change"])
def test_steady_noise_does_not_vary_whatever_else_happens(kind):
    """One of a hundred varies by chance; more than two of twelve would be one in 5,000."""
    rng, found = np.random.default_rng(3), []
    for seed in (11, 12, 13, 14):
        given = recording(np.ones(N), seed, "standard_t" if kind == "heavy tails" else "standard_normal")
        x = given.values.copy()
        if kind == "rounded":
            step = WHITE * np.sqrt(RATE)
            x = step * np.round(x / step)
        elif kind == "lines that vary":
            # Up to three times the noise, and from none to all of it.
            swell = (1.0 + np.sin(2.0 * np.pi * TIME / 400.0)) * np.sin(2.0 * np.pi * 17.0 * TIME)
            x += 3.0 * WHITE * np.sqrt(RATE) * swell[:, None]
        elif kind == "slow change":
            # The bias walks ten times as fast in the second half.
            x += np.cumsum(
                np.where(TIME > 320.0, 10.0 * WALK, 0.0)[:, None] * rng.standard_normal((N, 3)), axis=0
            )
        given = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=list(AXES))
        found += [r["N"] for r in aj.fit(given, "N + K", as_is=True).results if r.measured]
    told = [c.variation is not None and c.variation.size > 0.0 for c in found]
    assert sum(told) <= 2
    if kind == "slow change":
        # A change at hundreds of seconds never touches N.
        assert np.median([c.std for c in found]) == pytest.approx(WHITE / np.sqrt(2.0 * N), rel=0.2)


def test_the_ends_of_a_record_do_not_vary():
    """N below strong quantization, to which the kinks of the mirrored record add at both ends."""
    told = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        x = 5.0 * np.diff(rng.standard_normal((2**18 + 1, 1)), axis=0) + 0.05 * rng.standard_normal(
            (2**18, 1)
        )
        found = aj.fit(x, "Q + N", rate=RATE, gyro_unit="rad/s", names=["gyro_x"], as_is=True)["gyro_x"]["N"]
        told.append(found.variation is not None and found.variation.size > 0.0)
    # One of a hundred varies by chance.
    assert sum(told) <= 1


def test_bursts_are_told_and_no_variation():
    amplitude = np.ones(N)
    amplitude[20_000:20_100] = 8.0
    found = [r["N"] for r in aj.fit(recording(amplitude, 21), "N + K", as_is=True).results]
    # They add 63·100/65,536 to the power, within the scatter of 300 samples.
    assert np.mean([c.variation.excess for c in found]) == pytest.approx(31.5 * 100.0 / N, rel=0.3)
    for c in found:
        # A block has 64 samples; a hundred are in two or three of 1,024.
        assert 0.0015 < c.variation.louder < 0.004
        assert "louder bursts" in str(c.variation)
    assert sum(c.variation.size > 0.0 for c in found) <= 1


def test_bias_instability_that_doubles_varies_by_a_third():
    """Means of 1 and 2 have a mean of 1.5 and a deviation of 0.5; four windows or more show it roughly."""
    rng, n, sizes = np.random.default_rng(5), 4 * N, []
    time = np.arange(n) / RATE
    for _ in range(3):
        # Flicker noise as a sum of Markov processes an octave apart.
        flicker = np.zeros((n, 3))
        for T in 2.0 ** np.arange(-8.0, 12.0):
            pole = np.exp(-1.0 / (RATE * T))
            steps = rng.standard_normal((n, 3)) * np.sqrt((1.0 - pole**2) * np.log(2.0) / np.pi)
            for k in range(3):
                flicker[:, k] += _recursion(steps[:, k], pole)
        x = 5e-4 * np.sqrt(RATE) * rng.standard_normal((n, 3))
        x += 2e-3 * np.where(time < time[-1] / 2.0, 1.0, 2.0)[:, None] * flicker
        given = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=list(AXES))
        fit = aj.fit(given, "N + B", as_is=True)
        sizes += [r["B"].variation.size for r in fit.results]
    found = [size for size in sizes if size > 0.0]
    assert len(found) >= 7
    assert np.median(found) == pytest.approx(1.0 / 3.0, rel=0.3)


def _recursion(steps, pole):
    from scipy.signal import lfilter

    return lfilter([1.0], [1.0, -pole], steps)


def test_a_variation_is_in_the_table_the_json_and_what_is_loaded(tmp_path):
    fit = aj.fit(recording(course("step"), 1), "N + K")
    text = " ".join(fit.details().split())
    assert str(fit["gyro_x"]["N"].variation) in text
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(aj.to_dict(fit)))
    loaded = aj.load(path)
    for name in AXES:
        assert loaded[name]["N"].variation == fit[name]["N"].variation
        assert loaded[name]["N"].std == pytest.approx(fit[name]["N"].std)
