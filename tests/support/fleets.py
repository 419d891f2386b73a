"""Fleets whose fits are made up: stored as an earlier run would have left them, and judged by a later one."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import allanjax as aj

ARW = "angle_random_walk"


def coefficient(label: str, value: float, error: float, limit: float | None = None, **more: Any) -> dict:
    """A coefficient with a relative standard error, as JSON has it; with a limit it is not detected."""
    seen, ratio = limit is None, np.exp(1.96 * error)
    shown = {"value": value if seen else 0.0, "std": error * value, "upper_limit_95": limit, "detected": seen}
    ends = [value / ratio, value * ratio] if seen else [0.0, limit]
    about = {"label": label, "term": label, "unit": "deg/√h", "measured": True, "interval_95": ends}
    return about | shown | more


def axis(name: str, coefficients: Sequence[dict], **more: Any) -> dict:
    of_all = {"name": name, "sensor": name.split("_")[0], "converged": True, "reason": "", "p_value": 0.5}
    of_all |= {"measured": all(c["measured"] for c in coefficients), "not_measured": [], "verdict": "fits"}
    return of_all | {"coefficients": list(coefficients), "selection": None, "extension": None} | more


class Fleet:
    """Files in a folder, of which nothing but size and time is looked at, and stored fits of them.

    key: that of a stored fit of the current version of allanjax, whose options are taken.
    """

    def __init__(self, folder: Path, key: dict) -> None:
        self.folder, self.key = folder, key
        self.out = folder / "out"

    def file(self, name: str) -> Path:
        """A file that is there, and cannot be read as a recording."""
        path = self.folder / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text("0\n", encoding="utf-8")
        return path

    def store(self, name: str, axes: Sequence[dict], path: Path | None = None, **more: Any) -> None:
        """Leave the fit of a file as an earlier run would have."""
        path = (path or self.file(name)).resolve()
        size, modified = path.stat().st_size, path.stat().st_mtime_ns
        key = self.key | {"path": str(path), "size": size, "modified_ns": modified}
        fit = {"axes": list(axes), "name": name, "warnings": [], "facts": [], "stretch_s": None} | more
        folder = self.out / "recordings"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(json.dumps({"key": key, "fit": fit}), encoding="utf-8")

    def judged(
        self, *parts: tuple, group: Sequence | None = None, unit: Sequence | None = None
    ) -> aj.FleetResult:
        """Result for (sensor, label, values [units, axes], errors, limits if any) of unit_0, unit_1, …

        If their units are given, they are recordings of these.
        """
        shutil.rmtree(self.out, ignore_errors=True)
        files = [self.file(f"unit_{u}") for u in range(len(parts[0][2]))]
        for u, file in enumerate(files):
            axes: dict[str, list] = {}
            for sensor, label, values, errors, *limits in parts:
                errors = np.broadcast_to(errors, np.shape(values))
                limit = limits[0] if limits else np.full(np.shape(values), np.nan)
                for name, value, error, end in zip("xyz", values[u], errors[u], limit[u], strict=False):
                    end = None if np.isnan(end) else float(end)
                    found = coefficient(label, float(value), float(error), end)
                    axes.setdefault(f"{sensor}_{name}", []).append(found)
            self.store(file.stem, [axis(name, found) for name, found in axes.items()])
        named = {
            option: {f"unit_{u}": str(name) for u, name in enumerate(names)}
            for option, names in (("group", group), ("unit", unit))
            if names is not None
        }
        return self.run(files, **named)

    def run(self, files: Sequence[Path], **options: Any) -> aj.FleetResult:
        return aj.characterize_fleet(files, self.out, **options)


def marks(result: aj.FleetResult) -> list[tuple[str, str]]:
    return [*zip(result.outlying["recording"], result.outlying["axis"], strict=True)]
