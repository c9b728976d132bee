"""Transfers between particles and grid: PIC, FLIP and APIC."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Annotated, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix, NodeScalar, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import between, require_fields
from mpmjax.discretisation._fused_sums import average
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._native_sums import call_g2p, call_p2g
from mpmjax.discretisation._stencil import Basis, Stencil
from mpmjax.discretisation._sums import gather, scatter


class Gathered(eqx.Module):
    """A velocity field of the nodes, gathered at the particles."""

    value: Float[Array, "d p"]  # Σ_i w_ip v_i [m/s], shape (d, p)
    gradient: Matrix  # Σ_i v_i g_ipᵀ [1/s], shape (d, d, p), by the scene's gradient operator
    affine: Matrix | None
    """Σ_i v_i g_ipᵀ [1/s], shape (d, d, p), by moving least squares; None unless the transfer is `affine`."""


class ParticleMotion(NamedTuple):
    """The result of G2P at the particles."""

    carrier: Float[Array, "d p"]  # the velocity with which they move, Σ_i w_ip v̄_i [m/s], shape (d, p)
    velocity: Float[Array, "d p"]  # their new velocity [m/s], shape (d, p)
    affine: Matrix | None  # their new C [1/s], shape (d, d, p); None if they keep none
    gradient: Matrix  # the velocity gradient that deforms them, Σ_i v̄_i g_ipᵀ [1/s], shape (d, d, p)
    x: Float[Array, "d p"]  # their new positions [m], shape (d, p)
    F: Matrix | None  # their new deformation gradient [-], shape (d, d, p); None unless they were given one


class AbstractTransfer(eqx.Module):
    """The update of the particles' velocity, and of their affine velocity, from that of the nodes."""

    affine: ClassVar[bool] = False
    """Whether particles keep an affine velocity C [1/s]: P2G then gives Σ_p w_ip m_p (v_p + C_p (x_i − x_p))."""
    needs_change: ClassVar[bool] = False
    """Whether `velocity` or `affine_velocity` uses the change of the nodes' velocity over the step. P2G then sums
    momentum and force separately, which makes an explicit step dearer."""

    @abstractmethod
    def velocity(self, v: Float[Array, "d p"], new: Gathered, change: Gathered | None) -> Float[Array, "d p"]:
        """The particles' velocity after the step [m/s], shape (d, p).

        Args:
            v: the particles' velocity before the step [m/s], shape (d, p).
            new: the nodes' velocity after the step, v_i^{n+1}.
            change: its change over the step, v_i^{n+1} − v_i^n; None unless `needs_change`.
        """

    def affine_velocity(self, C: Matrix | None, new: Gathered, change: Gathered | None) -> Matrix | None:
        """The particles' affine velocity after the step [1/s], shape (d, d, p); None unless the transfer is `affine`.
        Default: the moving-least-squares gradient of the new velocity.

        Args:
            C: the affine velocity before the step [1/s], shape (d, d, p).
            new: as in `velocity`.
            change: as in `velocity`.
        """
        return new.affine

    def steepness(self, inverse_moment: Array, gradient_bound: Array) -> tuple[Array, Array] | None:
        """A and B [1/m²] of the bound Δt² Λ A/ρ0 + Δt Λ_v B/ρ0 ≤ 4 of `stable_dt`, for elasticity and viscosity.
        Default: None, with which `stable_dt` raises.

        Args:
            inverse_moment: a, the largest eigenvalue of D_p⁻¹ [1/m²].
            gradient_bound: Ξ, a bound of Σ_i g_ip g_ipᵀ/w_ip [1/m²].
        """
        return None


class PIC(AbstractTransfer):
    """Particle-in-cell: particles take the grid's velocity (F. H. Harlow, Methods Comput. Phys. 3 (1964) 319).

    Conserves linear momentum. In every step it loses angular momentum, and all velocity that the grid does not resolve.
    First order in space.
    """

    def velocity(self, v: Float[Array, "d p"], new: Gathered, change: Gathered | None) -> Float[Array, "d p"]:
        return new.value

    def steepness(self, inverse_moment: Array, gradient_bound: Array) -> tuple[Array, Array] | None:
        """2Ξ and 4Ξ."""
        return 2 * gradient_bound, 4 * gradient_bound


class FLIP(AbstractTransfer):
    """FLIP(α): particles take the change of the grid's velocity, blended with PIC (J. U. Brackbill, H. M. Ruppel,
    J. Comput. Phys. 65 (1986) 314, doi 10.1016/0021-9991(86)90211-1).

    v ← α (v + Σ_i w_ip (v_i^{n+1} − v_i^n)) + (1 − α) Σ_i w_ip v_i^{n+1}. Where a wall or grip holds a component of a
    node's velocity, v_i^n has the prescribed value too, so that the particles keep what the boundary has no claim to.
    With α = 1 it dissipates nothing, not even noise in the null space of the transfer. Particles bring no gradient C to
    the nodes, so that nodes at free surfaces turn more slowly than the body: of a disk 12 cells wide by 4 %, 24 wide by
    1 %.

    Args:
        alpha: share of FLIP, from 0 (PIC) to 1.
    """

    alpha: Annotated[Scalar, between(0, 1)] = 0.99
    needs_change: ClassVar[bool] = True
    __check_init__ = require_fields

    def velocity(self, v: Float[Array, "d p"], new: Gathered, change: Gathered | None) -> Float[Array, "d p"]:
        assert change is not None
        return self.alpha * (v + change.value) + (1 - self.alpha) * new.value

    def steepness(self, inverse_moment: Array, gradient_bound: Array) -> tuple[Array, Array] | None:
        """2Ξ and 4Ξ."""
        return 2 * gradient_bound, 4 * gradient_bound


class APIC(AbstractTransfer):
    """Affine particle-in-cell (C. Jiang, C. Schroeder, A. Selle, J. Teran, A. Stomakhin, ACM Trans. Graph. 34 (2015)
    51, doi 10.1145/2766996).

    Particles have an affine velocity C [1/s]. Conserves linear and angular momentum. Second order in space with
    quadratic and cubic kernels.
    """

    affine: ClassVar[bool] = True

    def velocity(self, v: Float[Array, "d p"], new: Gathered, change: Gathered | None) -> Float[Array, "d p"]:
        return new.value

    def steepness(self, inverse_moment: Array, gradient_bound: Array) -> tuple[Array, Array] | None:
        """2Ξ − a and 2a."""
        return 2 * gradient_bound - inverse_moment, 2 * inverse_moment


def without_empty(
    stencil: Stencil, mass: Float[Array, "p"], mirrored: Callable[[NodeScalar], NodeScalar], grid: Grid
) -> Stencil:
    """The stencil without a gradient along each axis in which a particle would read the velocity of empty nodes.

    An empty node has no velocity. The linear kernel's slope does not vanish with its weight, so that a particle on a
    node would read those beside it. The gradients of a particle still sum to zero: motion as a whole deforms nothing,
    and forces lose no momentum.

    Args:
        stencil: stencil of the particles.
        mass: m_p [kg], shape (p,).
        mirrored: function of the nodes' masses [kg], shape (n,), that adds those of their mirror images.
        grid: the grid.
    """
    fixed, mass = jax.lax.stop_gradient((stencil, mass))
    rounding = jnp.finfo(mass.dtype).eps
    empty = mirrored(scatter(fixed, mass[None], None, grid.size)[:, 0]) <= rounding * mass.min()
    _, read = gather(fixed, empty.astype(mass.dtype)[:, None])
    reads = jnp.abs(read) * grid.spacing > jnp.sqrt(rounding)  # less is read where another axis's weight is rounding
    return replace(stencil, flat=reads[:, 0])


Impulse = tuple[Scalar, Any, Any]
"""Factors c, a number, A and B, of shape (d, d, p), of a matrix c A Bᵀ for each particle: c A where B is None. In place
of A there may be numbers (q, r) of each particle, for c (q B Bᵀ + r I), or c r I where q and B are None."""


def p2g(
    stencil: Stencil,
    mass: Float[Array, "p"],
    v: Float[Array, "d p"],
    C: Matrix | None,
    size: int,
    impulse: Impulse | None = None,
    push: Float[Array, "d"] | None = None,
) -> tuple[NodeScalar, NodeVector]:
    """Particles to grid: m_i = Σ_p w_ip m_p and m_i v_i = Σ_p w_ip m_p (v_p + C_p (x_i − x_p)).

    Conserves mass and linear momentum, and with the affine term angular momentum, to rounding. Nodes whose mass is only
    the rounding of the lightest particle's are empty: a mean would empty the nodes of a body much lighter than others.

    Args:
        stencil: stencil of the particles.
        mass: m_p [kg], shape (p,).
        v: v_p [m/s], shape (d, p).
        C: affine velocity [1/s], shape (d, d, p), or None.
        size: number of nodes.
        impulse: factors of I_p [kg m²/s], to add Σ_p I_p g_ip to the momentum in the same sum. g_ip is the
            moving-least-squares gradient if there is a C.
        push: a velocity that is added to every v_p [m/s], shape (d,), or None for zero.

    Returns:
        mass m_i [kg], shape (n,), and velocity v_i [m/s], shape (n, d); both are zero on empty nodes.
    """
    used, least = stencil if C is None else stencil.least_squares, jnp.finfo(mass.dtype).eps * mass.min()
    return p2g_sum(used, least, mass, v, C, impulse, push, basis=used.basis, size=size)


@partial(
    custom_derivative,
    kernel="p2g",
    results=lambda _, least, mass, v, *__, size, **___: tuple(
        jax.ShapeDtypeStruct(shape, v.dtype) for shape in ((size,), (size, len(v)))
    ),
    call=call_p2g,
)
def p2g_sum(
    stencil: Stencil, least: Array, mass: Array, v: Array, C: Any, impulse: Any, push: Array | None, **params: Any
) -> tuple[Array, Array]:
    """`p2g` for a stencil whose gradients are those of both C and impulse."""
    v = v if push is None else v + push[:, None]
    terms = []
    if impulse is not None:
        factor, A, B = impulse
        if isinstance(A, tuple):
            q, r = A
            bent = 0.0 if B is None else q * la.matmul(B, la.transpose(B))
            terms.append(factor * (bent + r * jnp.eye(len(v), dtype=v.dtype)[:, :, None]))
        else:
            terms.append(factor * (A if B is None else la.matmul(A, la.transpose(B))))
    if C is not None:  # w (x_i − x_p) = D g, with g the moving-least-squares gradient
        terms.append(mass * C * stencil.moment)
    gradients = la.transpose(reduce(jnp.add, terms)) if terms else None
    return average(stencil, mass, mass * v, gradients, least, params["size"])


p2g_sum.differentiated_as_written()


@partial(
    custom_derivative,
    kernel="g2p",
    results=lambda _, nodes, dt, x, F, **__: (x, jax.ShapeDtypeStruct((len(x), *x.shape), x.dtype), x, F),
    call=call_g2p,
)
def g2p_sum(
    stencil: Stencil, nodes: NodeVector, dt: Scalar, x: Float[Array, "d p"], F: Matrix | None, *, basis: Basis
) -> tuple[Float[Array, "d p"], Matrix, Float[Array, "d p"], Matrix | None]:
    """A velocity v of the nodes at the particles, its gradient, x + Δt v and F + Δt (∇v) F."""
    value, slopes = gather(stencil, nodes, saved=True)
    gradient = la.transpose(slopes)
    return value, gradient, x + dt * value, None if F is None else F + dt * la.matmul(gradient, F)


g2p_sum.differentiated_as_written()


def g2p(
    transfer: AbstractTransfer,
    stencil: Stencil,
    dt: Scalar,
    x: Float[Array, "d p"],
    v: Float[Array, "d p"],
    before: NodeVector | None,
    after: NodeVector,
    mean: NodeVector | None = None,
    *,
    C: Matrix | None = None,
    F: Matrix | None = None,
    keep_gradient: bool = False,
) -> ParticleMotion:
    """Grid to particles.

    Args:
        transfer: the transfer.
        stencil: stencil of the particles.
        dt: Δt [s].
        x: the particles' positions [m], shape (d, p).
        v: the particles' velocity before the step [m/s], shape (d, p).
        before: v_i^n with the prescribed values where a boundary holds [m/s], shape (n, d); needed by transfers with
            `needs_change` only.
        after: v_i^{n+1} [m/s], shape (n, d).
        mean: the velocity v̄_i with which positions and deformation move [m/s], shape (n, d). Default: v_i^{n+1}.
        C: the particles' affine velocity before the step [1/s], shape (d, d, p), if they have one.
        F: their deformation gradient [-], shape (d, d, p), if it is to be strained in the same pass.
        keep_gradient: whether transfers that are not affine return a C too, Σ_i v_i^{n+1} g_ipᵀ.
    """
    change = None
    if transfer.needs_change:
        if before is None:
            raise ValueError(f"{type(transfer).__name__} needs the change of the nodes' velocity: give before.")
        change = after - before
    moving, fields = after if mean is None else mean, [field for field in (after, change) if field is not None]
    carrier, gradient, x, F = g2p_sum(stencil, moving, jnp.asarray(dt), x, F, basis=stencil.basis)
    # Each by itself: what computes has code of its own for as many columns as there are axes.
    seen = []
    for field in fields:
        if field is moving:
            seen.append((carrier, gradient))
        else:
            value, slopes = gather(stencil, field, saved=True)
            seen.append((value, la.transpose(slopes)))
    affine: list[Matrix | None] = [None] * len(fields)
    if transfer.affine and stencil.is_least_squares:
        affine = [slope for _, slope in seen]
    elif transfer.affine:
        _, slopes = gather(stencil.least_squares, jnp.concatenate(fields, axis=1), saved=True)
        affine = [la.transpose(part) for part in jnp.split(slopes, len(fields), axis=1)]
    each = zip(seen, affine, strict=True)
    new, changed, *_ = *(Gathered(value, slopes, slope) for (value, slopes), slope in each), None
    C = transfer.affine_velocity(C, new, changed) if transfer.affine else new.gradient if keep_gradient else None
    return ParticleMotion(carrier, transfer.velocity(v, new, changed), C, gradient, x, F)
