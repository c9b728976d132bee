"""The line search of Newton's method."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int

MOST_HALVINGS = 30
_SUFFICIENT_DECREASE = 1e-4


def backtrack(
    merit: Callable[[Float[Array, ""]], Float[Array, ""]],
    start: Float[Array, ""],
    slope: Float[Array, ""],
    slack: Float[Array, ""],
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """The first step size a of 1, ½, ¼, ... with sufficient decrease, E(a) ≤ E(0) + 10⁻⁴ a E'(0) + slack (L. Armijo,
    Pacific J. Math. 16 (1966) 1, doi 10.2140/pjm.1966.16.1).

    The slack is the rounding of E. Near a minimum the expected decrease is smaller than it, and without slack a good
    step would be refused. NaN is no decrease, so a step that leaves the domain of E is halved.

    Args:
        merit: the function E of the step size [J].
        start: E(0).
        slope: E'(0), negative.
        slack: by how much E may miss the decrease [J].

    Returns:
        The step size, and the number of halvings. At `MOST_HALVINGS` the search has failed.
    """

    def refused(trial: tuple[Array, Array]) -> Bool[Array, ""]:
        size, halvings = trial
        decreased = merit(size) <= start + _SUFFICIENT_DECREASE * size * slope + slack
        return ~decreased & (halvings < MOST_HALVINGS)

    whole, zero_count = jnp.ones((), start.dtype), jnp.asarray(0, dtype=jnp.int32)
    return jax.lax.while_loop(refused, lambda trial: (trial[0] / 2, trial[1] + 1), (whole, zero_count))
