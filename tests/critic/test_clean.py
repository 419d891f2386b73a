"""Clean records of several grades, colours and units: nothing is found, and nothing is told to be unlikely."""

import bench
import critic_records as cr
import golden_records
import numpy as np
import pytest
from scipy.stats import kstest

#: Golden records of noise only, and the axes of hidden effects that are too weak to be told.
CLEAN = [*golden_records.CLEAN, "lossy"]
WEAK = [*cr.SCENES, "other"]


def critiques():
    """All of them."""
    return [bench.critique(name) for name in CLEAN] + [cr.critique(name, 1.0 / 3.0) for name in cr.SCENES]


@pytest.mark.parametrize("name", CLEAN)
def test_a_clean_record_has_no_finding(name):
    found = bench.critique(name)
    assert found.findings == ()
    assert found.shared_findings == ()
    assert found.gain == 0.0
    for axis in found.results:
        assert axis.findings == ()
        assert axis.before == axis.after
        assert len(axis.stages) == 1
        assert axis.left_out == ()
        # Fourteen statistics of five axes or fewer.
        assert min(d.p_value for d in axis.before) > 1e-5
        assert set(axis.model.term_labels) <= set(golden_records.LABELS.values()) | {"markov"}


@pytest.mark.parametrize("name", WEAK)
def test_nothing_is_told_of_what_is_a_third_of_the_limit(name):
    assert cr.critique(name, 1.0 / 3.0).findings == ()


def test_p_values_of_clean_records_are_uniform():
    """Of discrepancies that take any value, and of the causes' tests, in some twenty axes.

    An effect at a third of its limit makes p-values no smaller than an e-th.
    """
    axes = [axis for found in critiques() for axis in found.results]
    p = [d.p_value for axis in axes for d in axis.before if d.statistic not in ("lattice", "repeated_values")]
    assert len(p) > 200
    tests = [value for axis in axes for name, value in axis.tests.items() if name != "temperature"]
    assert len(tests) == 6 * len(axes)
    for values in (p, tests):
        assert kstest(values, "uniform").pvalue > 1e-3
        assert min(values) > 1e-3 / len(values)
    # The mean of so many, which are not all independent.
    assert np.mean(p) == pytest.approx(0.5, abs=4.0 * 2.0 / np.sqrt(12.0 * len(p)))
