"""Programs of a fit that are compiled, or loaded from the cache, while a recording is read and inspected."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

Programs = Iterator[Callable[[], object]]
# What has been compiled ahead in this process.
_done: set[object] = set()


@contextmanager
def compiling_ahead(programs: Callable[[], Programs], wanted: bool = True) -> Iterator[None]:
    """Context in which a second thread gets programs ready, once in a process.

    At the end of the context it finishes the program that it is compiling, but begins no other one.
    """
    if not wanted or programs in _done:
        yield
        return
    _done.add(programs)
    ended = threading.Event()
    thread = threading.Thread(target=_compile, args=(programs, ended))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _compile(programs: Callable[[], Programs], ended: threading.Event) -> None:
    for program in programs():
        if ended.is_set():
            return
        program()


def of_spectra() -> Programs:
    """Programs of a fit without a given model, which are the same for all recordings.

    They run with data of no meaning, in the order in which fits need them.
    """
    from allanjax.estimate.axis_fits import fit_whittle
    from allanjax.estimate.selection import ranked
    from allanjax.estimate.spectral.components import CAPACITIES, levels_of
    from allanjax.estimate.spectral.model import FULL, Slots, maximize
    from allanjax.noise.terms import basic_terms
    from allanjax.record.recording import Recording
    from allanjax.spectrum.cosine import Bins

    x, model = np.random.default_rng(0).standard_normal((1024, 1)), basic_terms()
    recording = Recording.from_array(x, rate=1.0, gyro_unit="rad/s", names=["gyro"])
    yield lambda: ranked(recording)
    yield lambda: fit_whittle(recording, 0, model, np.ones(len(model), bool), {})
    # The same for many levels.
    m = CAPACITIES[-1]
    slots = Slots.of(FULL, np.zeros(FULL.parameters, bool), np.zeros(FULL.components, bool))
    levels = levels_of(Bins.of(len(x), 1.0), np.zeros((0, 2, 0)), FULL.columns, m)
    yield lambda: maximize(slots.usual(), slots, levels, np.ones(m))
