"""The preconditioner of averaged volumes."""

import itertools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, NodeVector
from mpmjax.boundary import Image, Mirror
from mpmjax.checks import require, require_fields
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.implicit._band_cholesky import BandCholesky, band_cholesky
from mpmjax.implicit._hessian_action import AveragedStiffness, ParticleStiffness
from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._preconditioner import AbstractPreconditioner, DiagonalPreconditioner
from mpmjax.implicit._projection import Projection

_STIFFEST = 0.3  # of C s, times √ε: where S⁻¹ is known to ε C s, P⁻¹ − P⁻¹Bᵀ S⁻¹ B P⁻¹ keeps 1/(C s) of P⁻¹


class VolumePreconditioner(AbstractPreconditioner):
    """The diagonal of M + χH without the stiffness of averaged volumes, and that stiffness as a whole:

        W = P + Bᵀ C B,    W⁻¹ = P⁻¹ − P⁻¹Bᵀ S⁻¹ B P⁻¹,    S = C⁻¹ + B P⁻¹ Bᵀ

    (Woodbury's identity). (B u)_i = Σ_p N_i(x_p) V0_p δJ_p is the change of volume at a node, and C the diagonal of its
    lumped stiffness χ Σ_p N_i k_p/(Σ_p N_i V0_p)² [kg/m^2d], with N and k as in `AveragedVolume` and its Hessian. The
    eigenvalues of W⁻¹(M + χH) then lie between those of the parts without averages and those of the average's stiffness
    over the lumped one, so that the number of iterations does not grow as ν goes to ½. S, which has one number a node
    of the window and material, is factored once a solve, as a band matrix. Without averaged volumes it is
    `DiagonalPreconditioner`.

    *When it breaks*: the factor takes (10/3) K b³ operations, with b the nodes of four of the window's planes across
    its longest axis and K a fourth of its length: it is for two dimensions and for small windows in three. Where it has
    more than `largest` numbers, on periodic grids and with rigid parts, the diagonal is taken. In float32, C is bounded
    by what the precision can tell, about a thousand times shear. Solvers other than `ConjugateResidual` take the
    diagonal too.
    *Good values*: for ν from 0.49 on (docs/nearly_incompressible.md has iterations and times).

    Args:
        largest: largest number of entries of the factor, 2 K b². Default: 2·10⁷, 160 MB in float64.
    """

    largest: int = eqx.field(static=True, default=20_000_000)

    def __check_init__(self):
        require_fields(self)
        require(self.largest >= 0, f"VolumePreconditioner's largest must not be negative, got {self.largest}.")

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        operator = operator.precomputed()
        diagonal, stiffness = DiagonalPreconditioner().inner_product(operator), operator.hessian
        assert isinstance(stiffness, ParticleStiffness)
        if not stiffness.averaged or not isinstance(diagonal, DiagonalInnerProduct):
            return diagonal
        order = _Order.of(stiffness)
        if order is None or 2 * order.blocks * order.size**2 > self.largest:
            return diagonal
        own = eqx.tree_at(lambda h: h.averaged, stiffness, ())
        mass = operator.nodal_mass()
        weight = operator.projection.commuting_weight(mass + operator.factor * own.diagonal(mass))
        return _inner_product(operator, stiffness, weight, order, diagonal)


class _Divergence(eqx.Module):
    """B and its transpose."""

    stencil: Stencil
    mirror: Mirror
    projection: Projection
    averaged: tuple[AveragedStiffness, ...]

    def __call__(self, v: NodeVector) -> Float[Array, "a n"]:
        """B v, one row for each material with averaged volumes."""
        slopes = gather(self.stencil, self.mirror.unfold(self.projection.combine(v, 0)))[1]
        return jnp.stack(
            [
                one.average.at_nodes(la.double_dot(one.volumetric, slopes[..., slice(*one.rows)]))
                for one in self.averaged
            ]
        )

    def transpose(self, q: Float[Array, "a n"]) -> NodeVector:
        """Bᵀ q."""
        d, particles = self.projection.free.shape[1], self.stencil.inside.shape[0]
        flux = jnp.zeros((d, d, particles), q.dtype)
        for one, own in zip(self.averaged, q, strict=True):
            flux = flux.at[..., slice(*one.rows)].set(one.volumetric * one.average.at_particles(own))
        return self.projection.combine(self.mirror.fold(scatter(self.stencil, None, flux, q.shape[1])), 0)


class VolumeInnerProduct(AbstractInnerProduct):
    """The inner product of W = P + Bᵀ C B (see `VolumePreconditioner`)."""

    weight: NodeVector
    """The diagonal of P [kg], shape (n, d)."""
    divergence: _Divergence
    softness: Float[Array, "a n"]
    """1/C [m^2d/kg]; infinite where B counts for nothing."""
    factor: BandCholesky
    order: "_Order"
    diagonal: DiagonalInnerProduct

    @property
    def paired(self) -> bool:
        return True

    def factored(self) -> DiagonalInnerProduct:
        """The inner product of the diagonal of M + χH."""
        return self.diagonal

    def apply(self, v: NodeVector) -> NodeVector:
        return self.weight * v + self.divergence.transpose(self.divergence(v) / self.softness)

    def solve(self, r: NodeVector) -> NodeVector:
        z = r / self.weight
        known = jnp.isfinite(self.softness)
        right = self.order.blocked(jnp.where(known, self.divergence(z), 0))
        q = self.order.unblocked(self.factor.solve(right))
        return z - self.divergence.transpose(jnp.where(known, q, 0)) / self.weight

    def solve_factor(self, r: Any) -> Any:
        raise NotImplementedError("VolumeInnerProduct has no factor; take that of factored().")

    def solve_factor_transpose(self, v: Any) -> Any:
        return self.solve_factor(v)


class _Order(eqx.Module):
    """The order of the nodes in which S is block tridiagonal: planes across the longest axis, `reach` of them a block,
    with as many numbers at a node as there are materials with averages."""

    shape: tuple[int, ...] = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    reach: int = eqx.field(static=True)
    """Largest distance of two nodes that S couples, in spacings along an axis."""
    materials: int = eqx.field(static=True)

    @staticmethod
    def of(stiffness: ParticleStiffness) -> "_Order | None":
        """None where S is no band matrix."""
        average = stiffness.averaged[0].average
        if any(average.periodic) or any(not isinstance(image, Image) for image in stiffness.mirror.images):
            return None
        support = stiffness.stencil.weights.shape[1]
        reach = 2 * (math.ceil(1 + support / 2) - 1)  # twice that of a hat and a spline of so many cells
        return _Order(average.shape, int(np.argmax(average.shape)), reach, len(stiffness.averaged))

    @property
    def planes(self) -> int:
        """Number of planes."""
        return self.shape[self.axis]

    @property
    def plane(self) -> int:
        """Number of nodes of one plane."""
        return math.prod(self.shape) // self.planes

    @property
    def blocks(self) -> int:
        """K."""
        return -(-self.planes // self.reach)

    @property
    def size(self) -> int:
        """b."""
        return self.reach * self.materials * self.plane

    def lined(self, field: Array) -> Array:
        """A field of nodes (..., n) with the planes in a row, shape (..., planes, plane)."""
        lattice = jnp.moveaxis(
            field.reshape(*field.shape[:-1], *self.shape), field.ndim - 1 + self.axis, field.ndim - 1
        )
        return lattice.reshape(*field.shape[:-1], self.planes, self.plane)

    def blocked(self, field: Float[Array, "a n"]) -> Float[Array, "k b"]:
        """A field as blocks, zero beyond the last plane."""
        rows = jnp.moveaxis(self.lined(field), 0, 1)
        spare = self.blocks * self.reach - self.planes
        return jnp.pad(rows, ((0, spare), (0, 0), (0, 0))).reshape(self.blocks, self.size)

    def unblocked(self, rows: Float[Array, "k b"]) -> Float[Array, "a n"]:
        """And back."""
        planes = rows.reshape(-1, self.materials, self.plane)[: self.planes]
        others = [length for axis, length in enumerate(self.shape) if axis != self.axis]
        lattice = jnp.moveaxis(planes, 1, 0).reshape(self.materials, self.planes, *others)
        return jnp.moveaxis(lattice, 1, 1 + self.axis).reshape(self.materials, -1)

    def colours(self) -> np.ndarray:
        """A number for each node, shape (n,), that no two nodes within reach of one share."""
        period = 2 * self.reach + 1
        each = np.meshgrid(*(np.arange(length) % period for length in self.shape), indexing="ij")
        return np.sum([colour.reshape(-1) * period**axis for axis, colour in enumerate(each)], axis=0)

    def matrix(self, columns: Float[Array, "c a t n"]) -> tuple[Float[Array, "k b b"], Float[Array, "k b b"]]:
        """The blocks on the diagonal and those below it, from the products of S with each colour's nodes.

        Args:
            columns: S e for e of one at one material's nodes of one colour, shape (materials, colours, materials, n).
        """
        found, colours = self.lined(columns), jnp.asarray(self.lined(jnp.asarray(self.colours())))
        places = [np.arange(length) for axis, length in enumerate(self.shape) if axis != self.axis]
        inside = np.stack([p.reshape(-1) for p in np.meshgrid(*places, indexing="ij")]) if places else np.zeros((1, 1))
        near = jnp.asarray((np.abs(inside[:, :, None] - inside[:, None]) <= self.reach).all(axis=0))
        count, along = np.arange(self.materials), jnp.arange(self.reach)

        def block(first: Array, other: Array) -> Array:
            r, q = (first * self.reach + along, other * self.reach + along)
            rows = r[:, None, None, None, None, None], count[:, None, None, None, None], np.arange(self.plane)
            row_plane, row_material, row_node = rows[0], rows[1], rows[2][:, None, None, None]
            plane, material, node = q[:, None, None], count[:, None], np.arange(self.plane)
            colour = colours.at[plane, node].get(mode="clip")
            value = found.at[material, colour, row_material, row_plane, row_node].get(mode="clip")
            known = (jnp.abs(row_plane - plane) <= self.reach) & near[row_node, node] & (plane >= 0)
            known &= (row_plane < self.planes) & (plane < self.planes)
            whole = jnp.where(known, value, 0).reshape(self.size, self.size)
            beyond = jnp.repeat(r >= self.planes, self.size // self.reach)
            return whole + jnp.diag(jnp.where(beyond & (first == other), 1.0, 0.0).astype(whole.dtype))

        numbers = jnp.arange(self.blocks)
        return jax.lax.map(lambda k: (block(k, k), block(k, k - 1)), numbers)


def _inner_product(
    operator: ImplicitOperator,
    stiffness: ParticleStiffness,
    weight: NodeVector,
    order: _Order,
    diagonal: DiagonalInnerProduct,
) -> VolumeInnerProduct:
    divergence = _Divergence(stiffness.stencil, stiffness.mirror, operator.projection, stiffness.averaged)
    bulk = [one.average.inverse**2 * one.average.at_nodes(one.bulk) for one in stiffness.averaged]
    C = operator.factor * jnp.maximum(jnp.stack(bulk), 0)
    some, colours, materials = C > 0, jnp.asarray(order.colours()), len(stiffness.averaged)

    def column(which: Array) -> Array:
        material, colour = which
        q = (colours == colour) & (jnp.arange(materials) == material)[:, None] & some
        return jnp.where(some, divergence(divergence.transpose(q.astype(C.dtype)) / weight), 0)

    count = (2 * order.reach + 1) ** len(order.shape)
    pairs = jnp.asarray(list(itertools.product(range(materials), range(count))), dtype=colours.dtype)
    columns = jax.lax.map(column, pairs).reshape(materials, count, materials, -1)
    own = jnp.stack([columns[a, colours, a, jnp.arange(colours.size)] for a in range(materials)])
    least = jnp.sqrt(jnp.finfo(C.dtype).eps) / _STIFFEST * own
    softness = jnp.where(some, jnp.maximum(1 / jnp.where(some, C, 1), least), jnp.inf)
    added = jnp.where(some, softness, 1)
    lattice = colours == jnp.arange(count)[:, None]
    columns = columns + jnp.stack(
        [
            jnp.stack([jnp.where(lattice & (a == b), added[a], 0) for b in range(materials)], axis=1)
            for a in range(materials)
        ]
    )
    return VolumeInnerProduct(weight, divergence, softness, band_cholesky(*order.matrix(columns)), order, diagonal)
