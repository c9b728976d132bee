"""Transfers between particles and grid: PIC, FLIP and APIC."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Matrix, NodeScalar, NodeVector, Scalar
from mpmjax.checks import require_between, require_fields
from mpmjax.discretisation._stencil import Stencil
from mpmjax.discretisation._transfer_sums import gather, scatter


class PIC(eqx.Module):
    """Particle-in-cell: particles take the grid's velocity (F. H. Harlow, Methods Comput. Phys. 3 (1964) 319).

    Conserves linear momentum; loses angular momentum and, every step, all velocity that the grid does not resolve.
    First order in space.
    """

    affine: ClassVar[bool] = False
    needs_change: ClassVar[bool] = False


class FLIP(eqx.Module):
    """FLIP(α): particles take the change of the grid's velocity, blended with PIC (J. U. Brackbill, H. M. Ruppel,
    J. Comput. Phys. 65 (1986) 314, doi 10.1016/0021-9991(86)90211-1).

    v ← α (v + Σ_i w_ip (v_i^{n+1} − v_i^n)) + (1 − α) Σ_i w_ip v_i^{n+1}. With α = 1 nothing is dissipated, noise in
    the null space of the transfer included.

    Args:
        alpha: share of FLIP, from 0 (PIC) to 1.
    """

    alpha: Scalar = 0.99
    affine: ClassVar[bool] = False
    needs_change: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        require_between("FLIP's alpha", self.alpha, 0, 1)


class APIC(eqx.Module):
    """Affine particle-in-cell (C. Jiang, C. Schroeder, A. Selle, J. Teran, A. Stomakhin, ACM Trans. Graph. 34 (2015)
    51, doi 10.1145/2766996).

    Particles carry an affine velocity C [1/s]; linear and angular momentum are conserved by the transfers. Second order
    in space with quadratic and cubic kernels.
    """

    affine: ClassVar[bool] = True
    needs_change: ClassVar[bool] = False


Transfer = PIC | FLIP | APIC


def p2g(
    stencil: Stencil,
    mass: Float[Array, "p"],
    v: Float[Array, "d p"],
    C: Matrix | None,
    size: int,
    impulse: Matrix | None = None,
) -> tuple[NodeScalar, NodeVector]:
    """Particles to grid: m_i = Σ_p w_ip m_p and m_i v_i = Σ_p w_ip m_p (v_p + C_p (x_i − x_p)).

    Conserves mass and linear momentum, and with the affine term angular momentum, to rounding.

    Args:
        stencil: stencil of the particles.
        mass: m_p [kg], shape (p,).
        v: v_p [m/s], shape (d, p).
        C: affine velocity [1/s], shape (d, d, p), or None.
        size: number of nodes.
        impulse: what else the momentum receives in the same sum, Σ_p I_p g_ip [kg m²/s], shape (d, d, p), with g_ip the
            moving-least-squares gradient if there is a C.
    Returns:
        mass m_i [kg], shape (n,), and momentum m_i v_i [kg m/s], shape (n, d).
    """
    arms = [] if impulse is None else [impulse]
    if C is None:
        along = stencil
    else:  # w (x_i − x_p) = D g, with g the moving-least-squares gradient
        along = stencil.least_squares
        arms.append(mass * C * stencil.moment)
    slopes = jnp.pad(jnp.swapaxes(sum(arms), 0, 1), ((0, 0), (1, 0), (0, 0))) if arms else None
    nodes = scatter(along, jnp.concatenate([mass[None], mass * v]), slopes, size)
    return nodes[:, 0], nodes[:, 1:]


def g2p(
    transfer: Transfer,
    stencil: Stencil,
    v: Float[Array, "d p"],
    before: NodeVector,
    after: NodeVector,
    mean: NodeVector | None = None,
    *,
    kept: bool = False,
) -> tuple[Float[Array, "d p"], Float[Array, "d p"], Matrix | None, Matrix]:
    """Grid to particles.

    Args:
        transfer: PIC, FLIP or APIC.
        stencil: stencil of the particles.
        v: the particles' velocity before the step [m/s], shape (d, p).
        before: v_i^n [m/s], shape (n, d); only FLIP looks at it.
        after: v_i^{n+1} [m/s], shape (n, d).
        mean: with what the nodes move over the step, v̄_i [m/s], shape (n, d), if not with v_i^{n+1}.
        kept: whether PIC and FLIP return a C too, Σ_i v_i^{n+1} g_ipᵀ.
    Returns:
        the velocity that carries the particles, Σ_i w_ip v̄_i; their new velocity; their new C, if any; and the velocity
        gradient that deforms them, Σ_i v̄_i g_ipᵀ [1/s], shape (d, d, p).
    """
    fields = [after] if mean is None else [after, mean]
    if isinstance(transfer, FLIP):
        fields.append(after - before)
    values, gradients = gather(stencil, jnp.concatenate(fields, axis=1))
    arrived, *others = jnp.split(values, len(fields))
    slope, *other_slopes = (jnp.swapaxes(g, 0, 1) for g in jnp.split(gradients, len(fields), axis=1))
    new, C = arrived, slope if kept else None
    match transfer:
        case APIC() if stencil.affine_slopes is None:
            C = slope
        case APIC():
            C = jnp.swapaxes(gather(stencil.least_squares, after)[1], 0, 1)
        case FLIP(alpha=alpha):
            new = alpha * (v + others[-1]) + (1 - alpha) * arrived
        case PIC():
            pass
        case _:
            raise ValueError(f"A transfer must be PIC, FLIP or APIC, got {transfer!r}.")
    return (arrived, new, C, slope) if mean is None else (others[0], new, C, other_slopes[0])
