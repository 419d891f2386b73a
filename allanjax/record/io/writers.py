"""Writers of recordings in files that `read` reads again without arguments."""

import os
from pathlib import Path

import numpy as np

from allanjax.base.errors import RecordingError
from allanjax.record.recording import Recording


def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording in its own units as .csv, .parquet or .npz, with a column `time [s]`.

    Raises:
        RecordingError: another suffix, or a folder that is not there.
    """
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path}: a folder; give a file to write, .csv, .parquet or .npz")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: there is no folder {path.parent}; make it, or write elsewhere")
    match path.suffix.lower():
        case ".csv":
            pyarrow.csv.write_csv(pyarrow.table(recording.columns), path)
        case ".parquet":
            pyarrow.parquet.write_table(pyarrow.table(recording.columns), path)
        case ".npz":
            with path.open("wb") as stream:
                np.savez(stream, **recording.columns)  # type: ignore[arg-type]
        case suffix:
            raise RecordingError(
                f"{path}: can not write {suffix or 'a file without suffix'}; use .csv, .parquet or .npz"
            )
