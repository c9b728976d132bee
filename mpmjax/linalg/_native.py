"""For which matrices the native library has kernels."""

from typing import Any

import numpy as np


def matrices_fit(avals: Any, batched: int) -> bool:
    """Whether the library has a kernel for these: 3 x 3, of single or double precision."""
    (aval,) = avals
    return aval.shape[batched : batched + 2] == (3, 3) and aval.dtype in (np.float32, np.float64)
