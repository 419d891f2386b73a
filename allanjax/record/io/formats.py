"""Which format a file has, by what it begins with, whatever its suffix."""

from pathlib import Path
from typing import Literal

from allanjax.record.validation import Source

Format = Literal["parquet", "npy", "npz", "hdf5", "mat", "text"]

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def format_of(path: Path, label: str) -> Format:
    """The format of a file, which messages name `label`.

    Raises:
        RecordingError: there is no such file, or it can not be opened, or is empty.
    """
    source = Source(label)
    if path.is_dir():
        raise source.error(f"a folder; give a file, or a pattern such as '{path / '*.csv'}'")
    try:
        with path.open("rb") as stream:
            magic = stream.read(520)
    except FileNotFoundError as error:
        raise source.error("no such file; check the path") from error
    except OSError as error:
        raise source.error(
            f"can not be opened: {error.strerror}; check the file and its permissions"
        ) from error
    if not magic:
        raise source.error("the file is empty; give a file with one row of numbers per sample")
    if magic.startswith(b"PAR1"):
        return "parquet"
    if magic.startswith(b"\x93NUMPY"):
        return "npy"
    if magic.startswith(b"PK\x03\x04"):
        return "npz"
    # MATLAB's -v7.3 has a text header of 512 bytes before the HDF5 file.
    if _HDF5_MAGIC in (magic[:8], magic[512:520]):
        return "hdf5"
    if magic.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        return "mat"
    return "text"


def name_of(path: Path) -> str:
    """The file's name without its suffix."""
    return path.name.removesuffix(".gz").rsplit(".", 1)[0]
