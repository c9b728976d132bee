"""Whether the numbers of particles are finite."""

from functools import reduce

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool


def finite(a: Array) -> Bool[Array, "p"]:
    """Whether each particle's numbers are finite, of any shape (..., p). Unrolled: of a reduction XLA would make a loop
    within its loop over the particles."""
    return reduce(jnp.logical_and, [jnp.isfinite(a[i]) for i in np.ndindex(a.shape[:-1])])
