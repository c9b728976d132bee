"""The report of contact."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Int


class ContactInfo(eqx.Module):
    """How the active set was found."""

    sweeps: Int[Array, "*f"]
    """Solves before the last one."""
    violations: Int[Array, "*f"]
    """Places that pull or are entered all the same."""


def no_contact() -> ContactInfo:
    """The report of a scene without contact."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    return ContactInfo(zero, zero)
