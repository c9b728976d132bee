"""Descriptions: stencils at the current or at the reference positions."""

from typing import ClassVar

import equinox as eqx


class AbstractDescription(eqx.Module):
    """Where stencils stand and with respect to what gradients are taken.

    There are these two; a third would need deformation gradients of its own.
    """

    total: ClassVar[bool]
    """Whether gradients are with respect to the reference positions X, and stencils are computed once."""


class UpdatedLagrangian(AbstractDescription):
    """Stencils at the current positions, h_ip = F_pᵀ ∇_x w_ip: for anything that moves, meets or separates."""

    total: ClassVar[bool] = False


class TotalLagrangian(AbstractDescription):
    """Stencils at the reference positions, h_ip = ∇_X w_ip, computed once.

    For a body that neither separates nor meets anything but what it was attached to from the start: no cell crossing,
    no numerical fracture, second order at every amplitude. Boundaries act at reference nodes.
    """

    total: ClassVar[bool] = True
