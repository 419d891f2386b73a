"""Golden run: forty records of known truth keep their numbers, and the numbers keep to the truth.

A change of meaning is accepted by `python tests/golden/make.py --accept "why"`, which prints what changed.
"""

import json
import math
from pathlib import Path

import bench
import golden_numbers
import numpy as np
import pytest
from golden_records import CLEAN, EFFECTS, PLAIN, REAL, RECORDS, SHAPED
from scipy import stats

GOLDEN = json.loads((Path(__file__).parent / "golden.json").read_text(encoding="utf-8"))["records"]
# Records of one kind share their programs: a worker each, and those of real sensors wherever there is time.
KINDS = dict.fromkeys((*EFFECTS, *CLEAN), "critiques") | {name: name for name in REAL}
EACH = [
    pytest.param(name, marks=pytest.mark.xdist_group(f"golden {KINDS.get(name, 'fits')}")) for name in RECORDS
]


def now(name: str) -> dict[str, golden_numbers.Number]:
    try:
        return bench.once(f"golden {name}", lambda: golden_numbers.numbers_of(name))
    except FileNotFoundError as error:
        pytest.skip(f"{name} needs the folder that ALLANJAX_DATA names: {error}")


@pytest.mark.parametrize("name", EACH)
def test_a_record_keeps_its_numbers(name):
    found = now(name)
    assert found.keys() == GOLDEN[name].keys()
    far = {place: golden_numbers.distance(GOLDEN[name][place], number) for place, number in found.items()}
    assert {place: (GOLDEN[name][place][1], found[place].plain()[1]) for place in far if far[place] > 1} == {}


def test_no_drift_that_single_limits_cannot_see():
    """Over all estimates the differences are a twentieth of σ at most, and σ is the same within 2 %."""
    every = [golden_numbers.overall(GOLDEN[name], now(name)) for name in RECORDS if name not in REAL]
    moved, wider = (np.concatenate(part) for part in zip(*every, strict=True))
    assert len(moved) > 100
    assert np.sqrt(np.mean(np.square(moved))) <= 0.05
    assert abs(np.mean(wider)) <= 0.02


def deviations(name: str) -> dict[str, float]:
    """How far estimates are from the truth, in σ by the interval on the side of the truth."""
    z, record = {}, bench.truth(name)
    for objective in ["whittle"] if name in SHAPED else ["allan", "whittle"]:
        for result in bench.fit(name, record.model, objective).results:
            for label, c in result.coefficients.items():
                value = record.truth[result.axis.name].get(label)
                if value is not None and c.detected and c.value > 0.0:
                    end = c.interval[1] if value > c.value else c.interval[0]
                    # Of a positive value the interval is one of its logarithm; down to zero it is not.
                    best, true, end = (math.log(v) if end > 0.0 else v for v in (c.value, value, end))
                    z[f"{objective}/{result.axis.name}/{label}"] = 1.96 * (true - best) / abs(end - best)
    return z


@pytest.mark.parametrize("name", [*PLAIN, *SHAPED])
def test_the_truth_is_within_four_standard_deviations(name):
    for place, z in deviations(name).items():
        assert abs(z) < 4.0, place


def test_estimates_scatter_about_the_truth_as_they_say():
    """By one objective, for two of one record see the same noise."""
    z = [z for name in (*PLAIN, *SHAPED) for p, z in deviations(name).items() if p.startswith("whittle")]
    low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], len(z))
    assert low < np.sum(np.square(z)) < high
    # Of fifty intervals 92 to 98 % would be too narrow a range: two in a thousand of honest sets are outside.
    inside = np.sum(np.abs(z) < 1.96)
    assert stats.binom.cdf(inside, len(z), 0.95) > 1e-3


@pytest.mark.parametrize("name", EFFECTS)
def test_what_is_hidden_is_found_on_its_axes_and_nothing_else(name):
    hidden, found = (
        sorted((f.cause, sorted(f.axes)) for f in all_of)
        for all_of in (bench.truth(name).effects, bench.critique(name).findings)
    )
    assert found == hidden


def test_what_was_handled_is_left_out():
    """Six seconds at the begin, four at the end, to a second or two."""
    start, stop = bench.fit("handled").longest_part
    assert 5.0 <= start <= 9.0
    assert 156.0 <= stop <= 160.0


@pytest.mark.parametrize("name", ["handled", "lossy", "stretches"])
def test_trouble_costs_width_and_no_truth(name):
    """Coefficients of what is left are within 4 σ, and known less well than those of a whole record."""
    record = bench.truth(name)
    for result in bench.fit(name).results:
        N = result["angle_random_walk"]
        assert abs(N.value - record.truth[result.axis.name]["angle_random_walk"]) < 4.0 * N.std
        samples = np.isfinite(record.values[:, 0]).sum()
        # Of white noise alone the power is known to 2/samples, the coefficient to half of that in relation.
        assert N.std > 0.95 * N.value * np.sqrt(0.5 / samples)


def test_the_golden_run_sees_what_it_should():
    """Limits themselves: a number at its limit passes, beyond it not, whatever its kind."""
    for kind, before, near, beyond, scale in (
        ("likely", 1.0, 1.0009, 1.0011, 0.01),
        ("exact", [1.0, 2.0], [1.0, 2.0 + 1e-9], [1.0, 2.0 + 5e-9], 1.0),
        ("std", 1.0, 1.06, 1.08, 1.0),
        ("same", True, True, False, 1.0),
        ("p_value", 1e-9, 1e-30, 1e-5, 1.0),
        ("evidence", 100.0, 109.0, 111.0, 1.0),
        ("gain", 5.0, 6.4, 6.6, 1.0),
    ):
        far = [
            golden_numbers.distance([kind, before, scale], golden_numbers.Number(kind, x, scale))
            for x in (near, beyond)
        ]
        assert far[0] < 1.0 < far[1], kind
