"""Clean records and axes of several grades and colours: nothing is found, nothing is said to be unlikely."""

import bench
import golden_records
import numpy as np
import pytest
from scipy.stats import kstest

CLEAN = [*golden_records.CLEAN, "lossy"]


@pytest.mark.parametrize("name", CLEAN)
def test_a_clean_record_has_no_finding(name):
    found = bench.critique(name)
    assert found.findings == found.shared_findings == ()
    assert found.gain == 0.0
    for axis in found.results:
        assert axis.findings == axis.left_out == ()
        assert axis.before == axis.after
        assert len(axis.stages) == 1
        # Fourteen statistics of five axes or fewer.
        assert min(d.p_value for d in axis.before) > 1e-5
        assert set(axis.model.term_labels) <= set(golden_records.LABELS.values()) | {"markov"}


def test_p_values_of_axes_without_an_effect_are_uniform():
    """Of discrepancies that take any value, and of the causes' tests, in fifteen axes or more."""
    axes = []
    for name in {*CLEAN, *golden_records.EFFECTS} - {"common"}:
        hidden = {axis for effect in bench.truth(name).effects for axis in effect.axes}
        axes += [axis for axis in bench.critique(name).results if axis.axis.name not in hidden]
    p = [d.p_value for axis in axes for d in axis.before if d.statistic not in ("lattice", "repeated_values")]
    assert len(p) > 180
    tests = [value for axis in axes for name, value in axis.tests.items() if name != "temperature"]
    assert len(tests) == 6 * len(axes)
    for values in (p, tests):
        assert kstest(values, "uniform").pvalue > 1e-3
        assert min(values) > 1e-3 / len(values)
    # The mean of so many, which are not all independent.
    assert np.mean(p) == pytest.approx(0.5, abs=4.0 * 2.0 / np.sqrt(12.0 * len(p)))
