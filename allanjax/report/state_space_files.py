"""State spaces as files: NumPy, MATLAB and C."""

import os
import re

import numpy as np

from allanjax.base.errors import AllanjaxError
from allanjax.noise.state_space import StateSpace

_MATRICES = ("A", "H", "Q", "R", "P0")
_LAW = "x[k+1] = A x[k] + w[k], z[k] = H x[k] + v[k], cov w = Q, cov v = R, cov x[0] = P0; SI"


def to_numpy(space: StateSpace, path: str | os.PathLike[str]) -> None:
    """Write an .npz file of A, H, Q, R, P0, names, units and rate."""
    with open(path, "wb") as file:
        np.savez(
            file,
            **{name: getattr(space, name) for name in _MATRICES},
            names=np.array(space.names, str),
            units=np.array(space.units, str),
            rate=space.rate,
        )


def to_matlab(space: StateSpace) -> str:
    """Text of a MATLAB script that defines A, H, Q, R, P0, names, units and rate, to all digits."""
    lines = [f"% {_LAW}", f"% {space.model}", f"rate = {space.rate!r}; % Hz"]
    for name in _MATRICES:
        matrix = getattr(space, name)
        # An empty matrix keeps its shape.
        rows = ["  " + " ".join(repr(float(x)) for x in row) for row in matrix]
        text = "[\n" + ";\n".join(rows) + "]" if matrix.size else "zeros({}, {})".format(*matrix.shape)
        lines.append(f"{name} = {text};")
    for name in ("names", "units"):
        values = ", ".join("'" + text.replace("'", "''") + "'" for text in getattr(space, name))
        lines.append(f"{name} = {{{values}}};")
    return "\n".join(lines) + "\n"


def to_c_header(space: StateSpace, prefix: str = "noise") -> str:
    """Text of a C header: constants `NOISE_STATES` and `NOISE_RATE`, arrays `noise_A` to `noise_P0`.

    Raises:
        AllanjaxError: the prefix is no name in C, or the model has no states: C knows no empty arrays.
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", prefix):
        raise AllanjaxError(f"the prefix of a C header must be a name, e.g. noise, not {prefix!r}")
    if not space.size:
        raise AllanjaxError(f"{space.model} has no states, only white noise R: it needs no header")
    own = prefix.upper()
    lines = [f"/* {_LAW}", f"   {space.model} */", f"#ifndef {own}_H", f"#define {own}_H", ""]
    lines += [f"#define {own}_STATES {space.size}", f"#define {own}_RATE {space.rate!r} /* Hz */", ""]
    states = zip(space.names, space.units, strict=True)
    lines += [f"/* state {k}: {name} [{unit}] */" for k, (name, unit) in enumerate(states)]
    for name in _MATRICES:
        matrix = getattr(space, name)
        rows = ["    {" + ", ".join(repr(float(x)) for x in row) + "}" for row in matrix]
        shape = "".join(f"[{n}]" for n in matrix.shape)
        lines += [f"static const double {prefix}_{name}{shape} = {{", ",\n".join(rows), "};"]
    return "\n".join([*lines, "", f"#endif /* {own}_H */"]) + "\n"
