"""Contact of two bodies, each of which has a layer of nodes of its own at the same places.

The gap between them at a node is linear in the displacement u of the nodes about the start of the step,

    g_i(u) = g_i(0) + n_i · Σ_j q_ij (u_j^a − u_j^b),    Σ_j q_ij = 1,

where n is the unit normal from the body b to the body a and q_ij the mean over the patch of nodes around i. The gap is
that of the particles around, which do not follow a node that moves by itself: with u_i in place of the mean the forces
would do work that the gap knows nothing of. The forces on the two nodes of a place are opposite, so that they have
neither sum nor moment.
"""

import math
from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractSpringContact, ConstrainedNodes, friction_share
from mpmjax.discretisation import Grid, Stencil
from mpmjax.geometry import length
from mpmjax.potential import AbstractSpring, Displacement, Forces, Mirror

_SAMPLES = 256  # depths at which the distance of a half-space is tabulated
STIFFNESS = 2.0
"""α, the stiffness of contact of one body in its wave modulus over a spacing: that of half a spacing of it. A stiffer
contact makes more of the noise of gaps, some hundredths of a spacing: with 20 the pressure between two cylinders
differs by a third from node to node."""
_LEAST_DEPTH = 1e-3
"""Smallest mean depth of the particles around a node, in spacings, at which it counts as near the surface. Deep in a
body that is zero, in a lattice only rounding."""
_EMPTY = 1e-9  # the part of a cell below which a body is not felt at a node
_LEAST_SPREAD = 1e-2  # a variance of this many square spacings is added to that of where two bodies meet
_POWER = 2  # how often C⁻¹ is applied for the normal
_SHEET = 2  # how many nodes a direction C reaches on either side


def half_space(order: int, side: float) -> np.ndarray:
    """How far the surface of a half-space lies from the kernel's middle, in spacings and positive outside, by how deep
    its particles lie on average over the kernel: at equal depths from none to that of a particle at the kernel's end.
    The B-spline is made of its truncated powers; the first particles lie half a side behind the surface, in spacings.
    """
    reach = (order + 1) / 2
    distance = np.linspace(-reach, reach - side / 2, 16 * _SAMPLES, endpoint=False)
    y = distance[:, None] + side * (0.5 + np.arange(int(2 * reach / side) + 1))
    powers = [(-1) ** j * math.comb(order + 1, j) * np.maximum(y + reach - j, 0) ** order for j in range(order + 2)]
    kernel = np.where(y < reach, sum(powers) / math.factorial(order), 0)
    depth = np.maximum.accumulate((kernel * y).sum(axis=1) / kernel.sum(axis=1))
    return np.interp(np.linspace(0, reach, _SAMPLES + 1), depth, distance)


class Body(NamedTuple):
    """A body as the nodes of its layer see it: sums over its particles with weights w_ip V_p, V_p being their present
    volume. Lengths are in spacings."""

    part: Float[Array, "m"]  # Σ_p w_ip V_p / dx^d [-], shape (m,): about the part of the kernel that the body fills
    middle: Float[Array, "d m"]  # the mean of x_p − x_i [-], shape (d, m)
    side: Float[Array, "m"]  # the mean side of the particles, V_p^(1/d) [-], shape (m,)
    velocity: Float[Array, "d m"]  # their mean velocity [m/s], shape (d, m)
    modulus: Float[Array, "m"]  # their mean wave modulus at rest [Pa], shape (m,)
    density: Float[Array, "m"]  # their mean density [kg/m^d], shape (m,)


class Patch(eqx.Module):
    """The node itself and its neighbours, 3^d nodes around each node of one layer, with a weight each."""

    weight: Float[Array, "m"]  # μ_j ≥ 0, in any unit, shape (m,)
    shape: tuple[int, ...] = eqx.field(static=True)  # the grid's shape
    periodic: tuple[bool, ...] = eqx.field(static=True)  # periodic directions
    whole: Float[Array, "m"]  # Σ_j μ_j over each patch, shape (m,); 1 where it is zero

    def __init__(self, weight: Float[Array, "m"], shape: tuple[int, ...], periodic: tuple[bool, ...]):
        self.weight, self.shape, self.periodic = weight, shape, periodic
        whole = self.total(weight)
        self.whole = jnp.where(whole > 0, whole, 1)

    def total(self, field: Array) -> Array:
        """Σ_j f_j over the patch around each node, of shape (m,) or (m, d) as the field is."""
        blocks = field.reshape(*self.shape, -1)
        for axis, periodic in enumerate(self.periodic):
            blocks = moment(blocks, axis, 0, reach=1, periodic=periodic)
        return blocks.reshape(field.shape)

    def mean(self, field: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """Σ_j μ_j f_j/Σ_j μ_j, shape (m, d); zero where no node of the patch has weight."""
        return self.total(self.weight[:, None] * field) / self.whole[:, None]

    def spread(self, amount: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """The transpose of `mean`: what each node has [shape (m, d)], shared among its patch by the weights."""
        return self.weight[:, None] * self.total(amount / self.whole[:, None])

    def spread_square(self, amount: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """The patch with the squares of the shares."""
        return self.weight[:, None] ** 2 * self.total(amount / self.whole[:, None] ** 2)


def moment(blocks: Array, axis: int, power: int, *, reach: int, periodic: bool) -> Array:
    """Σ_k k^power f_{i+k} along an axis of nodes, k from −reach to reach."""
    around = [(reach, reach) if a == axis else (0, 0) for a in range(blocks.ndim)]
    wide = jnp.pad(blocks, around, mode="wrap" if periodic else "constant")
    parts = [
        k**power * jax.lax.slice_in_dim(wide, k + reach, k + reach + blocks.shape[axis], axis=axis)
        for k in range(-reach, reach + 1)
        if k != 0 or power == 0
    ]
    return reduce(jnp.add, parts)


class Coupling(AbstractSpring):
    """The springs between two bodies, along the normal and across it."""

    stretch: Float[Array, "k m"]  # g_i at u = 0 and zeros [m], shape (1 + d, m); zero where nothing is held
    stiffness: Float[Array, "k m"]  # k_i, and that of each direction across [N/m], shape (1 + d, m); zero likewise
    normal: Float[Array, "m d"]  # n_i [-], shape (m, d)
    patch: Patch  # the nodes over which displacements are averaged, by c_a c_b/(c_a + c_b) of the two bodies
    pair: tuple[int, int] = eqx.field(static=True)  # the numbers of the bodies a and b

    def elongation(self, moved: Displacement) -> Float[Array, "k m"]:
        """Σ_j q_ij (u_j^a − u_j^b) along n_i, and what is left of it [m], shape (1 + d, m)."""
        layers = moved.nodes.reshape(-1, *self.normal.shape)
        first, second = self.pair
        shift = self.patch.mean(layers[first] - layers[second])
        along = (self.normal * shift).sum(axis=1)
        return jnp.concatenate([along[None], (shift - along[:, None] * self.normal).T])

    def spread(self, amount: Float[Array, "k m"], size: int) -> Forces:
        """Nᵀ a, of amounts across the normal that have no part along it."""
        return self._on_both(self.patch.spread(amount[0][:, None] * self.normal + amount[1:].T), -1, size)

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        square = self.normal**2
        along = self.stiffness[0][:, None] * square + self.stiffness[1:].T * (1 - square)
        return self._on_both(self.patch.spread_square(along), 1, size)

    def _on_both(self, force: Float[Array, "m d"], sign: int, size: int) -> Forces:
        first, second = self.pair
        nodes = jnp.zeros((size // len(force), *force.shape), force.dtype)
        return Forces(nodes=nodes.at[first].add(force).at[second].add(sign * force).reshape(size, -1))


class BodyContact(AbstractSpringContact):
    """Two bodies that push and rub each other, and may part. Each node is a place.

    The normal at a node is along C⁻² Δ, with Δ the difference of the bodies' middles around it, and C the covariance of
    where they meet: of c_a c_b, c the parts of the kernel in the bodies, on the nodes around. They meet in a sheet. It
    is thin along the normal and wide across it, at an edge of a body too, where Δ alone is oblique.

    Along the normal a body around a node looks like a half-space. How deep it lies on average, weighted with the
    kernel, tells how far its surface is: an edge of the body beside the node does not change that. The gap is the sum
    of both bodies' distances.

    The spring between them is those of both in a row, of stiffness α (M + ρ w²)/dx each, α = 2, on the node's share of
    the surface, with the wave modulus M and the density ρ of the body, and w the velocity with which the two meet. The
    share is dx^(d−1) cos²(πs/2dx) (c_a + c_b) at a distance s < dx from the surface; over the nodes along the normal it
    sums to that part of the surface in which there are bodies. The spring feels the mean displacement of the nodes
    around it, and pushes all of them (see `Coupling`).

    Friction is at most μ times the push at each node, against the slip of the two bodies. In implicit steps springs f k
    across the normal, without stretch at the start of the step, take their part in the solve, where f =
    min(1, μ|g|/(w Δt))² with the gap g and the slip's velocity w at the start. So what rests is held, and what slides
    is left to the rest of the limit, after the solve. In the step in which slip begins friction may be more.
    """

    gap: Float[Array, "m"]  # g_i at the start of the step [m], shape (m,); infinite where a body is not felt
    near: Bool[Array, "m"]  # the nodes at which both bodies are felt, shape (m,)
    normal: Float[Array, "m d"]  # n_i [-], from the second body to the first, shape (m, d)
    stiffness: Float[Array, "m"]
    grip: Float[Array, "m"]  # f [-], shape (m,)
    coefficient: Scalar  # Coulomb coefficient [-]
    dt: Scalar
    share: Scalar
    patch: Patch  # the nodes around each, by c_a c_b/(c_a + c_b) of the two bodies
    pair: tuple[int, int] = eqx.field(static=True)  # the numbers of the bodies

    def spread(self, stretch: Array, stiffness: Array) -> Coupling:
        across = jnp.zeros_like(self.normal.T)
        stretch = jnp.concatenate([stretch[None], across])
        stiffness = jnp.concatenate([stiffness[None], across + self.grip * stiffness])
        return Coupling(stretch, stiffness, self.normal, self.patch, self.pair)

    def spring_gap(self, held: ConstrainedNodes) -> Array:
        return jnp.where(self.near, self._stretched(held)[0], jnp.inf)

    def _stretched(self, held: ConstrainedNodes) -> Float[Array, "k m"]:
        """The gap, and the slip of the step [m], shape (1 + d, m); zero where a body is not felt."""
        return self.springs(jnp.ones(self.gap.shape, bool)).stretched(held.moved) / self.share

    @staticmethod
    def stability_rate(
        contacts: tuple[Any, ...], nodal_mass: NodeScalar, mass: Array, steepness: Array
    ) -> Array | float:
        """2 max_j Σ_i k_i q_ij (1/m_j^a + 1/m_j^b) of the present springs, summed over the pairs of bodies, which is a
        bound (derivation, section 12)."""
        rate = 0.0
        for contact in contacts:
            first, second = (nodal_mass.reshape(-1, len(contact.gap))[body] for body in contact.pair)
            reduced = series_stiffness(first, second, first + second > 0)
            share = contact.patch.spread(contact.stiffness[:, None])[:, 0]
            rate = rate + 2 * jnp.where(reduced > 0, share / jnp.where(reduced > 0, reduced, 1), 0).max()
        return rate

    def friction(
        self, held: ConstrainedNodes, active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector]:
        """Opposite impulses on the two bodies, at most as large as those that stop the slip that springs have left."""
        count, (first, second) = len(self.gap), self.pair
        push = jnp.where(active, jnp.maximum(self.normal_impulse(held, residual), 0), 0)
        taken = jnp.where(active, self.dt * self.stiffness * self.grip * length(self._stretched(held)[1:].T), 0)
        left = self.coefficient * push - taken
        # what springs take beyond the limit at some nodes the others lack: else what rests would hold at any angle
        rest, whole = jnp.maximum(left, 0), jnp.maximum(left, 0).sum()
        rest = rest * jnp.maximum(left.sum(), 0) / jnp.where(whole > 0, whole, 1)
        limit = jnp.tile(rest, len(residual) // count)
        limit = held.nodes.potential.mirror.fold_scalar(limit).reshape(-1, count)[first]
        mass = held.nodes.mass.reshape(-1, count)
        reduced = series_stiffness(mass[first], mass[second], mass[first] + mass[second] != 0)

        def change(v: NodeVector) -> NodeVector:
            bodies = v.reshape(-1, *self.normal.shape)
            slip = bodies[first] - bodies[second]
            slip = slip - self.normal * (self.normal * slip).sum(axis=1, keepdims=True)
            stop = (-friction_share(slip, reduced, limit) * reduced)[:, None] * slip
            impulse = jnp.zeros_like(bodies).at[first].set(stop).at[second].set(-stop)
            return held.nodes.projection.combine(held.nodes.per_mass(impulse.reshape(v.shape)), 0)

        return change


def body_contact(
    a: Body,
    b: Body,
    pair: tuple[int, int],
    *,
    friction: Scalar,
    order: int,
    grid: Grid,
    images: Mirror,
    dt: Scalar,
    share: Scalar,
) -> BodyContact:
    """The contact of two bodies with these numbers, for a kernel of some order and the mirrors of symmetry planes."""
    spacing, both = jnp.asarray(grid.spacing), (a.part > _EMPTY) & (b.part > _EMPTY)
    normal = _normal(a, b, both, grid)
    depths = [sign * (normal * body.middle).sum(axis=0) for body, sign in ((a, 1), (b, -1))]
    first, second = (_distance(body, depth, order) for body, depth in zip((a, b), depths, strict=True))
    away = jnp.minimum(jnp.maximum(first, second), 1)
    felt = both & (depths[0] > _LEAST_DEPTH) & (depths[1] > _LEAST_DEPTH) & (away < 1)
    area = jnp.cos(jnp.pi / 2 * away) ** 2 * (a.part + b.part) * spacing ** (len(normal) - 1)
    leaving = (normal * (a.velocity - b.velocity)).sum(axis=0)
    stiff, other = (body.modulus + body.density * jnp.maximum(-leaving, 0) ** 2 for body in (a, b))
    modulus, weight = series_stiffness(stiff, other, felt), series_stiffness(a.part, b.part, both)
    weight = images.continued(jnp.tile(jnp.where(both, weight, 0), grid.layers))[: len(weight)]
    gap, slip = spacing * (first + second), length(a.velocity.T - b.velocity.T - (leaving * normal).T) * dt
    holds = jnp.maximum(-friction * gap, 0)  # the slip whose springs have all that friction may take of the push
    slides = felt & (slip > holds)
    return BodyContact(
        gap=jnp.where(felt, gap, jnp.inf),
        near=felt,
        normal=normal.T,
        stiffness=jnp.where(felt, STIFFNESS * modulus / spacing * area, 0),
        grip=jnp.where(friction > 0, jnp.where(slides, holds / jnp.where(slides, slip, 1), 1) ** 2, 0),
        coefficient=friction,
        dt=dt,
        share=share,
        patch=Patch(weight, grid.shape, grid.periodic),
        pair=pair,
    )


def series_stiffness(a: Array, b: Array, felt: Array | bool = True) -> Array:
    """The stiffness of two springs in series, a b/(a + b)."""
    return a * b / jnp.where(felt, a + b, 1)


def _normal(a: Body, b: Body, felt: Bool[Array, "m"], grid: Grid) -> Float[Array, "d m"]:
    """The unit normal from the second body to the first, shape (d, m); any where one of them is not felt."""
    # the bodies meet in a sheet, along which its places spread and across which they do not: C⁻¹ turns any direction
    # between the bodies towards its normal, in which C is least
    thin = la.cofactor(_spread(a.part * b.part, grid))  # C⁻¹, times its determinant
    thin = thin / la.trace(thin)
    direction = (a.middle - b.middle)[:, None]
    for _ in range(_POWER):
        direction = la.matmul(thin, direction)
    direction = direction[:, 0]
    square = (direction**2).sum(axis=0)
    felt = felt & (square > 0)
    return jnp.where(felt, direction, 0) / jnp.sqrt(jnp.where(felt, square, 1))


def _spread(field: Float[Array, "m"], grid: Grid) -> Matrix:
    """The covariance of a field's places, in the five nodes a direction around each node, in square spacings, shape
    (d, d, m); a little more where the field has one node alone."""
    d = grid.dim
    moments = {(0,) * d: field.reshape(grid.shape)}
    for axis in range(d):
        moments = {
            (*powers[:axis], power, *powers[axis + 1 :]): moment(
                sums, axis, power, reach=_SHEET, periodic=grid.periodic[axis]
            )
            for powers, sums in moments.items()
            for power in range(3 - sum(powers))
        }

    def of(*axes: int) -> Array:
        return moments[tuple(axes.count(axis) for axis in range(d))].reshape(-1)

    total = of()
    total = jnp.where(total > 0, total, 1)
    mean = [of(axis) / total for axis in range(d)]
    C = la.assemble([[of(a, b) / total - mean[a] * mean[b] for b in range(d)] for a in range(d)])
    return C + _LEAST_SPREAD * la.identity_like(C)


def _distance(body: Body, depth: Float[Array, "m"], order: int) -> Float[Array, "m"]:
    """The distance of a body's surface from each node in spacings, positive outside, shape (m,): interpolated between
    half-spaces of particles of no side and of half a spacing. What the side changes is of second order in it."""
    fine, coarse = half_space(order, 1 / 64), half_space(order, 1 / 2)
    place = jnp.clip(depth / ((order + 1) / 2), 0, 1) * _SAMPLES
    low = jnp.minimum(place.astype(jnp.int32), _SAMPLES - 1)
    rows = jnp.asarray(np.stack([fine, 4 * (coarse - fine)], axis=1), depth.dtype)
    row = rows[low] + (place - low.astype(place.dtype))[:, None] * (rows[low + 1] - rows[low])
    return row[:, 0] + body.side**2 * row[:, 1]
