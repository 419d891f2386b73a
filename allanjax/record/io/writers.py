"""Writers of recordings in files that `read` reads again without arguments."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.base.errors import RecordingError
from allanjax.record.recording import Recording


def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording in its own units as .csv, .parquet or .npz, with a column `time [s]`.

    Raises:
        RecordingError: another suffix, or a folder that is not there.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path}: a folder; give a file to write, .csv, .parquet or .npz")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: there is no folder {path.parent}; make it, or write elsewhere")
    columns = recording.columns
    match path.suffix.lower():
        case ".csv":
            _write_csv(columns, path)
        case ".parquet":
            _write_parquet(columns, path)
        case ".npz":
            _write_npz(columns, path)
        case suffix:
            raise RecordingError(
                f"{path}: can not write {suffix or 'a file without suffix'}; use .csv, .parquet or .npz"
            )


def _write_csv(columns: dict[str, np.ndarray], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.csv

    pa.csv.write_csv(pa.table(columns), path)


def _write_parquet(columns: dict[str, np.ndarray], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(columns), path)


def _write_npz(columns: dict[str, Any], path: Path) -> None:
    with path.open("wb") as stream:
        np.savez(stream, **columns)
