"""Deviations, counts and intervals that others have published for the two data sets of NIST SP 1065.

W. J. Riley, "Handbook of Frequency Stability Analysis", NIST Special Publication 1065 (2008): nine
frequencies of NBS Monograph 140, Annex 8.E, with their deviations in tables 29 and 30, page 107; a thousand
numbers of a generator, section 12.4, with those in table 31, page 108. The phases that Stable32 1.60 ships as
PHASE.DAT are the integral of the thousand less their mean; its printouts, with intervals, are in allantools'
tests/phasedat.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less

import allanjax as aj

NINE = np.array([892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0])
#: By the names that allantools has for them.
KINDS = {
    "adev": ("allan", False), "oadev": ("allan", True), "mdev": ("modified", True),
    "hdev": ("hadamard", False), "ohdev": ("hadamard", True),
}  # fmt: skip
each_kind = pytest.mark.parametrize("name", KINDS)


def thousand() -> np.ndarray:
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    # The next three are printed with the generator.
    assert numbers[1:4] == [395529916, 1209410747, 633705974]
    return np.array(numbers) / 2147483647


def curve(name: str, frequencies: np.ndarray, sizes, data_type: str) -> aj.AllanDeviation:
    """Of the data and, as a second axis, of something else; at a rate that is not one."""
    values, options = np.stack([frequencies, 3.0 * frequencies[::-1] + 1.0], axis=1), {"data_type": data_type}
    if data_type == "phase":
        values = np.concatenate([np.full((1, 2), 7.0), 7.0 + np.cumsum(values, axis=0) / 8.0])
    options |= zip(("kind", "overlapping"), KINDS[name], strict=True)
    return aj.allan_deviation(values, 8.0, cluster_times=[m / 8.0 for m in sizes], **options)


def assert_printed(found: np.ndarray, expected: list[float], digits: int) -> None:
    """Equal to the last digit printed, rounded or cut off."""
    expected = np.array(expected)
    last = 10.0 ** (np.floor(np.log10(expected)) + 1 - digits)
    assert_array_less(abs(found - expected), 1.01 * last)


# Tables 30 and 31. "Hadamard" is of overlapping clusters there; the other one is of table II of Riley's "The
# Calculation of Time Domain Frequency Stability". TDEV = τ·MDEV/√3, in samples.
PRINTED = {
    "adev": ([91.22945, 115.8082], [2.922319e-01, 9.965736e-02, 3.897804e-02]),
    "oadev": ([91.22945, 85.95287], [2.922319e-01, 9.159953e-02, 3.241343e-02]),
    "mdev": ([91.22945, 74.78849], [2.922319e-01, 6.172376e-02, 2.170921e-02]),
    "hdev": ([70.80608, 116.7980], [2.943883e-01, 1.052754e-01, 3.910860e-02]),
    "ohdev": ([70.80607, 85.61487], [2.943883e-01, 9.581083e-02, 3.237638e-02]),
}
TIME_DEVIATIONS = ([52.67135, 86.35831], [0.1687202, 0.3563623, 1.253382])


@each_kind
def test_nine_and_a_thousand_frequencies(name):
    for k, (data, sizes) in enumerate(((NINE, [1, 2]), (thousand(), [1, 10, 100]))):
        for data_type in ("rate", "phase"):
            found = curve(name, data, sizes, data_type)
            assert found.n == len(data)
            assert_printed(found.deviation[:, 0], PRINTED[name][k], 7)
            if name == "mdev":
                times = found.deviation[:, 0] * found.cluster_size / np.sqrt(3.0)
                assert_printed(times, TIME_DEVIATIONS[k], 7)


# Of Stable32: differences averaged, lower end, deviation, upper end; white noise (alpha 0), confidence 0.683.
STABLE32 = {
    "adev": """
        999 2.8515e-01 2.9223e-01 2.9987e-01; 499 1.9787e-01 2.0510e-01 2.1319e-01
        249 1.4201e-01 1.4943e-01 1.5815e-01; 124 1.0254e-01 1.1013e-01 1.1971e-01
        61 5.6510e-02 6.2381e-02 7.0567e-02; 30 4.9153e-02 5.6233e-02 6.7635e-02
        14 2.7109e-02 3.2550e-02 4.3537e-02; 6 2.6481e-02 3.3855e-02 5.5744e-02""",
    "oadev": """
        999 2.8515e-01 2.9223e-01 2.9987e-01; 997 1.9520e-01 2.0102e-01 2.0738e-01
        993 1.3931e-01 1.4479e-01 1.5098e-01; 985 1.0038e-01 1.0570e-01 1.1198e-01
        969 5.7696e-02 6.1915e-02 6.7217e-02; 937 4.3654e-02 4.8082e-02 5.4202e-02
        873 3.1755e-02 3.6237e-02 4.3377e-02; 745 2.3045e-02 2.7674e-02 3.7027e-02""",
    "mdev": """
        999 2.8515e-01 2.9223e-01 2.9987e-01; 996 1.5336e-01 1.5821e-01 1.6355e-01
        990 1.0322e-01 1.0780e-01 1.1304e-01; 978 6.9840e-02 7.4192e-02 7.9481e-02
        954 3.8022e-02 4.1376e-02 4.5809e-02; 906 3.0466e-02 3.4255e-02 3.9933e-02
        810 2.3687e-02 2.7871e-02 3.5511e-02; 618 1.4874e-02 1.8669e-02 2.8584e-02""",
    "hdev": """
        998 2.8635e-01 2.9439e-01 3.0315e-01; 498 1.9887e-01 2.0716e-01 2.1659e-01
        248 1.4054e-01 1.4890e-01 1.5896e-01; 123 1.0744e-01 1.1649e-01 1.2829e-01
        60 5.3296e-02 5.9589e-02 6.8811e-02; 29 4.6987e-02 5.4697e-02 6.8092e-02
        13 2.4870e-02 3.0569e-02 4.3652e-02; 5 2.8841e-02 3.8060e-02 7.3807e-02""",
    "ohdev": """
        998 2.8635e-01 2.9439e-01 3.0315e-01; 995 1.9491e-01 2.0125e-01 2.0825e-01
        989 1.3777e-01 1.4368e-01 1.5043e-01; 977 1.0388e-01 1.0987e-01 1.1704e-01
        953 5.6173e-02 6.0638e-02 6.6369e-02; 905 4.0664e-02 4.5095e-02 5.1382e-02
        809 2.9271e-02 3.3824e-02 4.1477e-02; 617 2.3761e-02 2.9147e-02 4.1367e-02""",
}


@each_kind
def test_counts_deviations_and_intervals_are_those_of_stable32(name):
    """Its degrees of freedom are of phases averaged over a sample, by Greenhall & Riley's approximation."""
    # So the half widths of its intervals differ at few samples a cluster, by 9 % at m = 1 and less as 1/m;
    # between m = 4 and 32 the approximation for overlapping clusters costs up to 6 %, and nothing beyond.
    rows = STABLE32[name].replace(";", " ").split()
    count, lower, deviation, upper = np.array(rows, float).reshape(-1, 4).T
    m = 2 ** np.arange(8)
    found = curve(name, thousand(), m, "phase")
    assert_array_equal(found.count, count)
    assert_printed(found.deviation[:, 0], deviation, 5)
    away = 0.105 / m + 0.003
    if name in ("oadev", "ohdev"):
        away += 0.06 * ((m >= 4) & (m <= 32))
    ends = found.confidence_interval(0.683)
    for end, theirs in zip(ends, (lower, upper), strict=True):
        half, their_half = abs(end[:, 0] - found.deviation[:, 0]), abs(theirs - deviation)
        assert_array_less(abs(half / their_half - 1.0), away)


@each_kind
def test_allantools_finds_the_same(name):
    """At all cluster times; allantools leaves out those with a single difference."""
    allantools = pytest.importorskip("allantools", reason="allantools is not installed")
    x = np.cumsum(thousand() - 0.5)
    found = curve(name, x, [1, 2, 3, 7, 50, 99, 140, 331], "rate")
    several = found.count > 1
    _, deviation, _, count = getattr(allantools, name)(x, 8.0, data_type="freq", taus=found.cluster_time)
    assert_array_equal(count, found.count[several])
    assert_allclose(found.deviation[several, 0], deviation, rtol=1e-9)
