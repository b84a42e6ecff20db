"""Type aliases for the arrays of function boundaries; docstrings state shapes."""

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
Code = npt.NDArray[np.uint8]
Ids = npt.NDArray[np.uint16]
Image = npt.NDArray[np.uint8]
