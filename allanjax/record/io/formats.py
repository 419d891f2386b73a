"""Recognition of the format of a file by its first bytes, or else by its name."""

import zlib
from pathlib import Path

from allanjax.base.wording import harmless
from allanjax.record.io.arrays import HDF5, MAT, NPY, NPZ, PARQUET, TDMS
from allanjax.record.io.flight_logs import DATAFLASH, ULOG
from allanjax.record.io.json_documents import JSON
from allanjax.record.io.ros import ROS
from allanjax.record.io.table import Format
from allanjax.record.io.text import TEXT
from allanjax.record.validation import Source

# Bytes of a name: file systems allow 255, with what is added to it.
_LONGEST_NAME = 200
#: Formats in the order in which they are tried; the last one is the fallback.
FORMATS = (PARQUET, NPY, NPZ, HDF5, MAT, ROS, ULOG, DATAFLASH, TDMS, JSON, TEXT)


def format_of(path: Path, source: Source) -> Format:
    """Return the format of a file, or of the folder of a ROS 2 bag."""
    if path.is_dir():
        if is_bag(path):
            return ROS
        raise source.error(
            f"this folder is not a ROS 2 bag, as it has no metadata.yaml; give a file, or a pattern such as "
            f"'{path / '*.csv'}'"
        )
    if path.exists() and not path.is_file():
        raise source.error("a pipe or a device, which can be read only once; copy it to a file")
    try:
        with path.open("rb") as stream:
            magic = stream.read(520)
    except FileNotFoundError as error:
        raise source.error("no such file; check the path") from error
    except OSError as error:
        raise source.error(f"cannot be opened: {error.strerror}; check its permissions") from error
    if not magic:
        raise source.no_rows()
    found = next(kind for kind in FORMATS if kind.matches(magic))
    if found is TEXT and b"\0" in magic:
        suffix = path.suffix.lower()
        return next((kind for kind in FORMATS if suffix in kind.suffixes), TEXT)
    return found


def is_bag(path: Path) -> bool:
    """Return whether a path is the folder of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def name_of(path: Path) -> str:
    """Return the name of a file without its suffix, as names of results have it."""
    return storable(path.name.removesuffix(".gz").rsplit(".", 1)[0] or path.name)


def storable(name: str) -> str:
    """A name that can be shown, and written with any suffix: a long one is cut, and a number added."""
    name = harmless(name)
    content = name.encode()
    if len(content) <= _LONGEST_NAME:
        return name
    return f"{content[: _LONGEST_NAME - 9].decode(errors='ignore')}-{zlib.crc32(content):08x}"
