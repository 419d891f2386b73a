"""Work on the axes of a recording at the same time, as many as there are cores."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def for_each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of a function for each item, in order; NumPy and compiled programs run in several threads."""
    every = list(items)
    if len(every) < 2:
        return list(map(function, every))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, every))
