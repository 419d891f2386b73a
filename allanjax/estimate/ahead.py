"""Programs of a fit that are compiled, or loaded from the cache, while a recording is read and inspected."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


@contextmanager
def compiling_ahead(wanted: bool = True) -> Iterator[None]:
    """Context in which a second thread gets the programs ready that a fit without a given model needs.

    They are few, and the same for all recordings (see `spectral.model`). At the end of the context the thread
    finishes the program that it is compiling, but begins no other one.
    """
    if not wanted:
        yield
        return
    ended = threading.Event()
    thread = threading.Thread(target=_compile, args=(ended,))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _compile(ended: threading.Event) -> None:
    """Run each program once with data of no meaning, in the order in which fits need them."""
    for program in _programs():
        if ended.is_set():
            return
        program()


def _programs() -> Iterator[Callable[[], object]]:
    from allanjax.estimate.axis_fits import fit_whittle
    from allanjax.estimate.gls import Solution
    from allanjax.estimate.selection import ranked
    from allanjax.estimate.spectral.components import CAPACITIES, levels_of
    from allanjax.estimate.spectral.fit import LevelDesign, infer_levels
    from allanjax.estimate.spectral.model import FULL, Slots, maximize
    from allanjax.noise.terms import basic_terms
    from allanjax.record.recording import Recording
    from allanjax.spectrum.cosine import Bins

    x, model = np.random.default_rng(0).standard_normal((1024, 1)), basic_terms()
    recording = Recording.from_array(x, rate=1.0, gyro_unit="rad/s", names=["gyro"])
    yield lambda: ranked(recording)
    yield lambda: fit_whittle(recording, 0, model, np.ones(len(model), bool), {})
    # The same for many levels and terms.
    m, terms = CAPACITIES[-1], FULL.columns + 1
    slots = Slots.of(FULL, np.zeros(FULL.parameters, bool), np.zeros(FULL.components, bool))
    levels = levels_of(Bins.of(len(x), 1.0), np.zeros((0, 2, 0)), FULL.columns, m)
    yield lambda: maximize(slots.usual(), slots, levels, np.ones(m))
    ones, here = np.ones((terms, m)), np.ones(terms, bool)
    design = LevelDesign.of(ones, np.zeros((terms, m, 1)), np.zeros(1), [0], np.ones(m), np.ones(m))
    values: Any = (np.ones(terms), np.zeros(1), *(np.asarray(x) for x in (0.0, 0.0, True, 0.0)))
    yield lambda: infer_levels(design, np.ones(m), here, here, _of_one_axis(Solution(*values)))


def _of_one_axis(solution: Any) -> Any:
    return type(solution)(*(np.asarray(x)[None] for x in solution))
