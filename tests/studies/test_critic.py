"""The critic's laws by many records of an independent generator: false alarms, p-values, intervals."""

import critic_truth as ct
import numpy as np
import pytest
from golden_records import UNITS
from scipy.stats import binom, chi2, kstest

import allanjax as aj
from benchmarks.common.hidden_effects import draw
from benchmarks.common.hidden_verdict import recording_of

pytestmark = pytest.mark.study


@pytest.fixture(scope="module")
def clean():
    """Critiques of clean records, half of them short, of random grades and colours."""
    given = [(1_000 + seed, 600.0 if seed % 2 else 100.0) for seed in range(400)]
    return [aj.critique(recording_of(draw(seed, None, duration=T, rate=50.0))) for seed, T in given]


def test_clean_records_have_findings_as_often_as_is_said(clean):
    """One in a hundred by `false_alarms`; no more than 99.9 % of such studies have."""
    told = [(f.cause, str(f)) for found in clean for f in found.findings]
    assert len(told) <= binom.ppf(0.999, len(clean), 0.01), told


def test_p_values_of_discrepancies_and_of_causes_are_uniform(clean):
    every = {}
    for axis in (axis for found in clean for axis in found.results):
        for d in axis.before:
            every.setdefault(d.statistic, []).append(d.p_value)
        for name, value in axis.tests.items():
            every.setdefault(name, []).append(value)
    for name, values in every.items():
        if name in ("lattice", "repeated_values"):
            assert min(values) > 1e-5
        else:
            assert kstest(values, "uniform").pvalue > 1e-4, name


@pytest.mark.parametrize("name", ["hum", "telegraph", "temperature", "louder", "more"])
def test_errors_are_as_large_as_is_said(name):
    """Squares of errors over their deviations, of twelve records of each effect."""
    z = {}
    for seed in range(1, 13):
        found = aj.critique(ct.record_of(name, seed).recording())
        for h in ct.hidden_in(name, seed):
            for finding in (f for f in found[h.axis].findings if f.cause == h.cause):
                for label in {*h.truth} - {"start", "end", "fraction"}:
                    e, in_unit = finding.parameters[label], label in ("amplitude", "coefficient")
                    scale = UNITS[h.axis[:-2]][1] if in_unit else 1.0
                    if e.std > 0.0:
                        z.setdefault((h.cause, label), []).append((e.value - h.truth[label] / scale) / e.std)
    for place, errors in z.items():
        assert len(errors) >= 10, place
        square = np.sum(np.square(errors))
        # Deviations that count a grid's spacing are a little too large.
        assert chi2.cdf(square, len(errors)) < 0.9995, place
        assert chi2.sf(2.0 * square, len(errors)) < 0.9995, place
