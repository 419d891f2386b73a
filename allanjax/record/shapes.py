"""Shapes of arrays of one row per sample, for annotations."""

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

#: Samples of axes, and which of them are meant.
Values = Float[np.ndarray, "samples axes"]
Which = Bool[np.ndarray, "samples axes"]
#: One number per sample, such as a temperature; times [s]; cells of any type.
Channel = Float[np.ndarray, " samples"]
Seconds = Float[np.ndarray, " samples"]
Cells = Shaped[np.ndarray, " samples"]
#: Which samples are meant; and places of samples on a grid.
Chosen = Bool[np.ndarray, " samples"]
Places = Int[np.ndarray, " samples"]
