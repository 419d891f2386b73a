"""What a critique costs, in what can be counted: full transforms, compiled programs, arrays that wait."""

from typing import ClassVar

import numpy as np
import pytest
import scipy.fft
from compilations import compilations

import allanjax as aj
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.search import _candidates, view_of

# Lengths for which spectra are padded to the same length and Allan sums are of the same octave.
SHORT, BETWEEN, LONG = 6200, 6600, 7000
# Transforms of the whole record in a critique of one axis without findings. Counted: 23 with these samples
# once the record's length is known, and a few more for each noise that a cause tries besides the best one.
MOST_TRANSFORMS = 32


class Counting:
    """Backend of scipy.fft that counts the transforms of each length, and leaves them to SciPy."""

    __ua_domain__ = "numpy.scipy.fft"
    lengths: ClassVar[list[int]] = []

    @classmethod
    def __ua_function__(cls, method, args, kwargs):
        cls.lengths.append(np.shape(args[0])[kwargs.get("axis", -1)])
        with scipy.fft.set_backend("scipy", only=True):
            return method(*args, **kwargs)


@pytest.fixture
def transforms():
    """Lengths of all transforms since the test began, in any thread."""
    Counting.lengths = []
    scipy.fft.set_global_backend(Counting)
    yield Counting.lengths
    scipy.fft.set_global_backend("scipy")


def white(n: int, step: float = 0.0) -> aj.Recording:
    """White noise of one gyro, with a step at its middle."""
    x = np.random.default_rng(5).standard_normal(n) + step * (np.arange(n) > n // 2)
    return aj.Recording.from_array(1e-3 * x[:, None], 100.0, gyro_unit="rad/s", names=["gyro_x"])


def test_an_axis_without_findings_takes_few_transforms(transforms) -> None:
    assert not aj.critique(white(SHORT)).findings
    assert 0 < sum(abs(n - SHORT) <= 1 for n in transforms) <= MOST_TRANSFORMS


def test_another_length_compiles_nothing() -> None:
    """Two lengths before, since what is tried depends on the samples, too."""
    for n in (SHORT, BETWEEN):
        aj.critique(white(n))
    with compilations() as names:
        aj.critique(white(LONG))
    assert names == []


def test_views_that_wait_keep_no_long_arrays() -> None:
    """What is as long as the record can be computed anew, and then makes the same decision."""
    recording = white(SHORT, step=1.0)
    x = recording.values[:, 0]
    view = view_of(recording.axes[0], 1.0, x, recording.rate, {}, None)
    (((_, waiting),), _) = _candidates(view, [BiasStep()], {}, lambda text: None)
    fields = set(type(view).__dataclass_fields__)
    kept = [value for name, value in vars(waiting.after).items() if name not in fields]
    assert not any(np.size(value) >= SHORT - 1 for value in kept if isinstance(value, np.ndarray))
    kept_by_noise = vars(waiting.after.noise).values()
    assert not any(np.size(value) >= SHORT - 1 for value in kept_by_noise if isinstance(value, np.ndarray))
    # Rounding apart, since the same is computed from the same samples.
    at_once = BiasStep().detect(view)
    np.testing.assert_allclose(waiting.held_out(), at_once.held_out(), rtol=1e-9)
