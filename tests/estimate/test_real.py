"""The shortest case of the study of real records, which have no truth."""

import pytest

from benchmarks.common.study import UnavailableError
from benchmarks.studies.real import QUICK, run


def test_halves_of_a_real_record_agree_and_predict_each_other():
    """51 s of six axes, whose counts are scaled: N is known to some per cent, and no model is off."""
    try:
        parts = list(run(**QUICK))
    except UnavailableError as reason:
        pytest.skip(str(reason))
    lines = [line.removeprefix("- ") for line in parts[1].splitlines() if line.startswith("- ")]
    told = dict(line.split(": ") for line in lines)
    assert float(told["relative σ of N"].split()[1]) < 2.0
    assert told["axes above 5 % whose halves agree within 5 %"] == "0 of 6"
    # One accelerometer's halves do differ, by 8 %.
    assert told["|z| of N below 2"] in ("5 of 6", "6 of 6")
    for other in ("plain", "allan-variance"):
        assert told[f"predicts the other half at least as well as {other}"] == "6 of 6"
    assert told["axes that do not fit"] == "0 of 6"
