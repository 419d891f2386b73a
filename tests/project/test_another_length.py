"""What is compiled is of use to the next recording: programs do not depend on numbers of samples."""

import bench
import numpy as np
from compilations import compilations

import allanjax as aj


def in_sevenths(recording):
    accumulator = aj.AllanAccumulator(recording.rate, recording.axes)
    for piece in np.array_split(recording.values, 7):
        accumulator.update(piece)


CALLS = [aj.power_spectrum, aj.autocorrelation, aj.wavelet_variance, aj.inspect, in_sevenths]


def test_a_second_length_compiles_nothing():
    recording = bench.recording("small")
    for call in CALLS:
        call(recording)
        with compilations() as compiled:
            call(recording.between(0.0, 94.77))
        assert compiled == [], call
