"""Reader for LabVIEW's TDMS files; it requires nptdms."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from allanjax.record.columns import split_unit
from allanjax.record.io.binary import from_named
from allanjax.record.io.table import Format, Table, damage_reported
from allanjax.record.validation import Source


def read_tdms(path: Path, source: Source) -> Table:
    """Return channels like the arrays of an .npz file, with their units and sample interval.

    If several groups have channels, these are named `group.channel`.

    Raises:
        RecordingError: nptdms is not installed, the file is damaged, or the channels do not fit together.
    """
    try:
        from nptdms import TdmsFile
    except ModuleNotFoundError as error:
        raise source.error('reading a TDMS file requires nptdms: pip install "allanjax[tdms]"') from error
    arrays: dict[str, np.ndarray] = {}
    warnings: list[str] = []
    intervals = set()
    size = path.stat().st_size
    with (
        _warnings_kept(warnings),
        damage_reported(source, "a TDMS file", "copy it again, or export it as CSV"),
        TdmsFile.open(path) as file,
    ):
        groups = [group for group in file.groups() if any(len(channel) for channel in group.channels())]
        for group in groups:
            for channel in group.channels():
                if len(channel) > size:
                    raise source.error(
                        f"{channel.name!r} claims {len(channel)} samples in {size} bytes; copy it again"
                    )
                name = channel.name if len(groups) == 1 else f"{group.name}.{channel.name}"
                unit = str(channel.properties.get("unit_string", "")).strip()
                label = f"{name} [{unit}]" if unit and split_unit(name)[1] is None else name
                if len(channel):
                    arrays[label] = channel[:]
                    intervals.add(float(channel.properties.get("wf_increment", 0.0)))
    if len(intervals) == 1 and (interval := intervals.pop()) > 0.0:
        arrays["dt"] = np.array(interval)
    table = from_named(arrays, source)
    damage = (f"the file is damaged: {warnings[0]}",) if warnings else ()
    return replace(table, notes=(*damage, *table.notes))


@contextmanager
def _warnings_kept(warnings: list[str]) -> Iterator[None]:
    """Context in which nptdms appends its warnings to a list instead of printing them."""
    from nptdms.log import log_manager

    def kept(record: logging.LogRecord) -> bool:
        warnings.append(record.getMessage()[:200])
        return False

    log_manager.console_handler.addFilter(kept)
    try:
        yield
    finally:
        log_manager.console_handler.removeFilter(kept)


TDMS = Format("TDMS", lambda magic: magic.startswith(b"TDSm"), read_tdms, (".tdms",), in_chunks=False)
