"""The descriptions: stencils at the current or at the reference positions."""

import equinox as eqx


class UpdatedLagrangian(eqx.Module):
    """Stencils at the current positions, h_ip = F_pᵀ ∇_x w_ip: for anything that moves, meets or separates."""


class TotalLagrangian(eqx.Module):
    """Stencils at the reference positions, h_ip = ∇_X w_ip, computed once.

    For a body that neither separates nor meets anything but what it was attached to from the start: no cell crossing,
    no numerical fracture, second order at every amplitude. Boundaries act at reference nodes.
    """


Description = UpdatedLagrangian | TotalLagrangian
