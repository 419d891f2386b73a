"""Results of several axes are mappings from the axes' names, whatever they are results of."""

from collections.abc import Mapping

import pytest

import allanjax as aj


@pytest.fixture(scope="module")
def mappings(small_fit, small_posterior, small_critique):
    """A result of each kind, with the names of its axes and the error that an unknown axis raises."""
    four = ["gyro_x", "gyro_y", "gyro_z", "accel_z"]
    return {
        "fit": (small_fit, four, aj.FitError),
        "selection": (small_fit.selection, four, aj.FitError),
        "posterior": (small_posterior, ["gyro_x"], aj.AllanjaxError),
        "critique": (small_critique, ["gyro"], aj.AllanjaxError),
    }


each = pytest.mark.parametrize("kind", ["fit", "selection", "posterior", "critique"])


@each
def test_it_is_a_mapping_from_names_to_results(mappings, kind):
    results, names, _ = mappings[kind]
    assert isinstance(results, Mapping)
    assert list(results) == list(results.keys()) == list(results.axes) == names
    assert len(results) == len(names)
    assert tuple(results.values()) == results.results
    assert dict(results.items()) == dict(zip(names, results.results, strict=True))
    for name, result in results.items():
        assert result.axis.name == name
        assert results[name] is results.get(name) is result
        assert name in results


@each
def test_an_unknown_axis_is_not_in_it(mappings, kind):
    results, names, error = mappings[kind]
    assert "mag_x" not in results
    assert results.get("mag_x") is None
    assert results.get("mag_x", results) is results
    with pytest.raises(error, match=f"has no axis 'mag_x'; it has {', '.join(names)}$") as caught:
        results["mag_x"]
    assert type(caught.value) is error


def test_the_message_has_the_name_of_the_recording_or_says_what_it_is(mappings):
    starts = {"fit": "small", "selection": "small", "posterior": "the posterior", "critique": "bench"}
    for kind, start in starts.items():
        with pytest.raises(aj.AllanjaxError, match=f"^{start} has no axis"):
            mappings[kind][0]["mag_x"]


@each
def test_it_tells_its_axes(mappings, kind):
    results, names, _ = mappings[kind]
    for told in (str(results), repr(results), results._repr_html_()):
        assert all(name in told for name in names)
