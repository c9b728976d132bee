"""The report of contact."""

import equinox as eqx

from mpmjax._types import Array, Int


class ContactInfo(eqx.Module):
    """How the active set was found."""

    sweeps: Int[Array, "*f"]
    """Solves before the last one."""
    violations: Int[Array, "*f"]
    """Places that pull or are entered all the same."""
