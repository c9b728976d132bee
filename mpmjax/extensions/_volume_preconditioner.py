"""The preconditioner of averaged volumes."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Int, NodeVector
from mpmjax.checks import as_plain, require, require_fields, whole
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.extensions._dissection import DissectedFactor, Dissection, dissected_factor
from mpmjax.implicit import (
    AbstractInnerProduct,
    AbstractPreconditioner,
    DiagonalInnerProduct,
    ImplicitOperator,
    ParticleStiffness,
    Projection,
)
from mpmjax.potential import Image, Mirror
from mpmjax.state import AveragedStiffness

_STIFFEST = 0.3  # of C s, times √ε: where S⁻¹ is bounded to ε C s, P⁻¹ − P⁻¹Bᵀ S⁻¹ B P⁻¹ keeps 1/(C s) of P⁻¹


class VolumePreconditioner(AbstractPreconditioner):
    """The diagonal of M + χH without the stiffness of averaged volumes, and that stiffness as a whole:

        W = P + Bᵀ C B,    W⁻¹ = P⁻¹ − P⁻¹Bᵀ S⁻¹ B P⁻¹,    S = C⁻¹ + B P⁻¹ Bᵀ

    (Woodbury's identity). (B u)_i = Σ_p N_i(x_p) V0_p δJ_p is the change of volume at a node, and C the diagonal of its
    lumped stiffness χ Σ_p N_i k_p/(Σ_p N_i V0_p)² [kg/m^2d], with N and k as in `AveragedVolume` and its Hessian. The
    eigenvalues of W⁻¹(M + χH) then lie between those of the parts without averages and those of the average's stiffness
    over the lumped one, so that the number of iterations does not grow as ν goes to ½. S, which has one number a node
    and material, is factored once a solve, by nested dissection. Without averaged volumes it is
    `DiagonalPreconditioner`.

    *When it breaks*: the factor is of a box of nodes, empty ones too, and grows fast with it in three dimensions: 8·10⁶
    numbers with 18 nodes a side, 24·10⁶ with 22, 58·10⁶ with 26, 127·10⁶ with 30. Where it has more than `largest`, on
    periodic grids and with rigid parts, the diagonal is taken. In float32, C is bounded by what the precision can tell,
    about a thousand times shear. Solvers other than `ConjugateResidual` take the diagonal too.
    *Good values*: for ν from 0.49 on; in three dimensions with an `extent` (docs/nearly_incompressible.md has
    iterations and times).

    Args:
        largest: largest number of entries of the factor. Default: 6·10⁷, 480 MB in float64; a solve takes about four
            times that at its peak.
        extent: how many nodes along each axis the bodies with averaged volumes take: their length in cells plus 2, and
            more if they grow. A box of so many nodes is laid from the first of their nodes on in each solve, wherever
            they are. What reaches beyond it is not preconditioned, so that iterations grow. Default: the whole window.
    """

    largest: Annotated[int, whole(0)] = eqx.field(static=True, default=60_000_000)
    extent: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    def __check_init__(self):
        require_fields(self)
        fits = self.extent is None or (len(self.extent) > 0 and all(length >= 1 for length in self.extent))
        require(fits, f"VolumePreconditioner's extent must be one node or more for each axis, got {self.extent}.")

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        operator = operator.precomputed()
        stiffness, projection, size = operator.hessian, operator.projection, len(operator.mass)
        assert isinstance(stiffness, ParticleStiffness)
        diagonal = DiagonalInnerProduct(projection.commuting_weight(operator.diagonal()))
        averaged = tuple(part for part in stiffness.coupled if isinstance(part, AveragedStiffness))
        planar = all(isinstance(image, Image) for image in stiffness.mirror.images)
        if not averaged or any(averaged[0].average.periodic) or not planar or stiffness.stencil.radius is not None:
            return diagonal  # B then sees no box of nodes, or a hoop that it does not know
        window = shape = averaged[0].average.shape
        if self.extent is not None:
            fits = len(self.extent) == len(window)
            require(fits, f"VolumePreconditioner's extent needs one for each of {len(window)} axes, got {self.extent}.")
            shape = tuple(min(pair) for pair in zip(self.extent, window, strict=True))
        # how many nodes away B sees along an axis: as far as a hat and a spline of so many cells overlap
        half = math.ceil(1 + len(stiffness.stencil.basis.knots) / 2) - 1
        dissection = Dissection(shape, 2 * half, len(averaged))
        if dissection.entries > self.largest:
            return diagonal
        divergence = _Divergence(stiffness.stencil, stiffness.mirror, projection, averaged)
        weight = operator.mass[:, None] + operator.factor * replace(stiffness, coupled=()).diagonal(size)
        weight = projection.commuting_weight(weight)
        bulk = [one.average.inverse**2 * one.average.at_nodes(one.bulk) for one in averaged]
        C = operator.factor * jnp.maximum(jnp.stack(bulk), 0)
        # the box begins where something is, as far as the window goes
        lattice, axes = (C > 0).any(axis=0).reshape(window), range(len(window))
        first = [jnp.argmax(lattice.any(axis=tuple(b for b in axes if b != a))) for a in axes]
        box = NodeBox(window, shape, jnp.minimum(jnp.stack(first), jnp.asarray(np.subtract(window, shape))))
        C = box.inside(C)
        some = C > 0
        S = nodal_coupling(divergence.transpose, weight, some, box, half)
        numbers, here = np.arange(len(C)), S.shape[2] // 2
        least = jnp.sqrt(jnp.finfo(C.dtype).eps) / _STIFFEST * S[numbers, numbers, here]
        softness = jnp.where(some, jnp.maximum(1 / jnp.where(some, C, 1), least), jnp.inf)
        S = S.at[numbers, numbers, here].add(jnp.where(some, softness, 1))
        factor = dissected_factor(dissection, partial(_entries, S, half, shape))
        return VolumeInnerProduct(weight, divergence, softness, factor, box, diagonal)


class NodeBox(eqx.Module):
    """A box of nodes in a window, which may be anywhere in it."""

    window: tuple[int, ...] = eqx.field(static=True)  # number of the window's nodes along each axis
    shape: tuple[int, ...] = eqx.field(static=True)  # number of the box's nodes along each axis
    corner: Int[Array, "d"]  # the box's first node along each axis

    def inside(self, field: Float[Array, "*a n"], spare: int = 0) -> Float[Array, "*a m"]:
        """A field of nodes (..., n) in the box and so many nodes around it, zero beyond the window."""
        front = field.shape[:-1]
        lattice = field.reshape(*front, *self.window)
        lattice = jnp.pad(lattice, [(0, 0)] * len(front) + [(spare, spare)] * len(self.window))
        sizes = [length + 2 * spare for length in self.shape]
        return jax.lax.dynamic_slice(lattice, self._start(front), (*front, *sizes)).reshape(*front, -1)

    def outside(self, field: Float[Array, "*a m"]) -> Float[Array, "*a n"]:
        """A field of the box's nodes (..., m) in the window, zero beyond the box."""
        front = field.shape[:-1]
        lattice = jnp.zeros((*front, *self.window), field.dtype)
        block = field.reshape(*front, *self.shape)
        return jax.lax.dynamic_update_slice(lattice, block, self._start(front)).reshape(*front, -1)

    def _start(self, front: tuple[int, ...]) -> tuple[Array, ...]:
        return (*(jnp.zeros_like(self.corner[0]) for _ in front), *self.corner)


def nodal_coupling(
    transpose: Callable[[Array], NodeVector], weight: NodeVector, some: Bool[Array, "a m"], box: NodeBox, half: int
) -> Float[Array, "a b s m"]:
    """B P⁻¹ Bᵀ: its entry for each number of node i and of node j = i + δ, by δ from −2 half to 2 half along each axis.

    Bᵀ of fields that are one at every (2 half + 1)-th node along each axis has each of its entries by itself. Each node
    of the vectors then couples all pairs of nodes that see it.

    Args:
        transpose: Bᵀ, of arrays (a, n).
        weight: the diagonal of P, shape (n, d).
        some: which numbers in the box count; the others' rows and columns are zero.
        box: the nodes that S couples.
        half: how many nodes away B sees.
    """
    d, period, count = weight.shape[1], 2 * half + 1, len(some)
    offsets = np.array(list(itertools.product(range(-half, half + 1), repeat=d)))  # of a vector's node from B's
    places = period ** np.arange(d)[::-1]

    def colours(shape: tuple[int, ...], shift: np.ndarray) -> np.ndarray:
        along = [(np.arange(length) + s) % period * p for length, s, p in zip(shape, shift, places, strict=True)]
        return reduce(np.add, np.ix_(*along)).reshape(-1)

    colour_of = jnp.asarray(colours(box.shape, np.zeros(d, int)))

    def column(which: tuple[Array, Array]) -> Float[Array, "d k"]:
        material, colour = which
        q = (colour_of == colour) & (jnp.arange(count) == material)[:, None] & some
        return box.inside(transpose(box.outside(q.astype(weight.dtype))).T, half)

    materials, numbers = (jnp.asarray(a) for a in np.divmod(np.arange(count * period**d), period**d))
    columns = jax.lax.map(column, (materials, numbers)).reshape(count, period**d, d, -1)
    wide = tuple(length + 2 * half for length in box.shape)
    seen = jnp.asarray(np.stack([colours(wide, -half - offset) for offset in offsets]))
    entries = jnp.take_along_axis(columns, seen[None, :, None], axis=1)  # of each vector's node, by offset
    lattices = entries.reshape(count, period**d, d, *wide)
    scale = box.inside(1 / weight.T, half).reshape(d, *wide)

    def add(total: Array, which: tuple[Array, Array]) -> tuple[Array, None]:
        number, offset = which
        one = jax.lax.dynamic_index_in_dim(lattices, number, 1, keepdims=False) * scale

        def cut(field: Array) -> Array:
            front = field.ndim - d
            start = (*(jnp.zeros_like(number) for _ in range(front)), *(half + offset))
            return jax.lax.dynamic_slice(field, start, (*field.shape[:front], *box.shape))

        one, other = cut(one), cut(lattices[:, ::-1])
        pairs = reduce(jnp.add, (one[:, None, None, k] * other[None, :, :, k] for k in range(d)))
        pairs = pairs.reshape(count, count, *(period,) * d, *box.shape)
        start = (*(jnp.zeros_like(number),) * 2, *(half + offset), *(jnp.zeros_like(number) for _ in range(d)))
        before = jax.lax.dynamic_slice(total, start, pairs.shape)
        return jax.lax.dynamic_update_slice(total, before + pairs, start), None

    nothing = jnp.zeros((count, count, *(4 * half + 1,) * d, *box.shape), weight.dtype)
    every = jnp.arange(len(offsets)), jnp.asarray(offsets, dtype=jnp.arange(0).dtype)
    total = jax.lax.scan(add, nothing, every)[0]
    return total.reshape(count, count, (4 * half + 1) ** d, -1)


def _entries(
    S: Float[Array, "a b s m"], half: int, shape: tuple[int, ...], rows: Int[Array, "i"], columns: Int[Array, "j"]
) -> Float[Array, "i j"]:
    """The entries of `nodal_coupling` in these rows and columns, zero past the last. The numbers of a node stand
    together."""
    count, span, reach = len(S), 4 * half + 1, 2 * half
    (i, a), (j, b) = (jnp.divmod(numbers, count) for numbers in (rows, columns))
    inside = (rows < math.prod(shape) * count)[:, None] & (columns < math.prod(shape) * count)
    distance = jnp.zeros(inside.shape, i.dtype)
    for one, other in zip(*(jnp.unravel_index(k, shape) for k in (i, j)), strict=True):
        apart = other - one[:, None]
        inside &= jnp.abs(apart) <= reach
        distance = span * distance + apart + reach
    return jnp.where(inside, S[a[:, None], b, distance, i[:, None]], 0)


class _Divergence(eqx.Module):
    """B and its transpose."""

    stencil: Stencil
    mirror: Mirror
    projection: Projection
    averaged: tuple[AveragedStiffness, ...]

    def __call__(self, v: NodeVector) -> Float[Array, "a n"]:
        """B v, one row for each material with averaged volumes."""
        slopes = gather(self.stencil, self.mirror.unfold(self.projection.combine(v, 0)))[1]
        changes = [la.double_dot(one.volumetric, slopes[..., slice(*one.rows)]) for one in self.averaged]
        return jnp.stack([one.average.at_nodes(change) for one, change in zip(self.averaged, changes, strict=True)])

    def transpose(self, q: Float[Array, "a n"]) -> NodeVector:
        """Bᵀ q."""
        d, particles = self.projection.free.shape[1], self.stencil.inside.shape[0]
        flux = jnp.zeros((d, d, particles), q.dtype)
        for one, part in zip(self.averaged, q, strict=True):
            flux = flux.at[..., slice(*one.rows)].set(one.volumetric * one.average.at_particles(part))
        return self.projection.combine(self.mirror.fold(scatter(self.stencil, None, flux, q.shape[1])), 0)


class VolumeInnerProduct(AbstractInnerProduct):
    """The inner product of W = P + Bᵀ C B (see `VolumePreconditioner`)."""

    weight: NodeVector  # the diagonal of P [kg], shape (n, d)
    divergence: _Divergence
    softness: Float[Array, "a m"]  # 1/C [m^2d/kg] of the box's nodes; infinite where B counts for nothing
    factor: DissectedFactor
    box: NodeBox
    diagonal: DiagonalInnerProduct

    def factored(self) -> DiagonalInnerProduct:
        """The inner product of the diagonal of M + χH."""
        return self.diagonal

    def apply(self, v: NodeVector) -> NodeVector:
        return self.weight * v + self._spread(self._change(v) / self.softness)

    def solve(self, r: NodeVector) -> NodeVector:
        z = r / self.weight
        bounded = jnp.isfinite(self.softness)
        right = jnp.where(bounded, self._change(z), 0)
        q = self.factor.solve(right.T.reshape(-1)).reshape(right.shape[::-1]).T
        return z - self._spread(jnp.where(bounded, q, 0)) / self.weight

    def _change(self, v: NodeVector) -> Float[Array, "a m"]:
        """B v in the box."""
        return self.box.inside(self.divergence(v))

    def _spread(self, q: Float[Array, "a m"]) -> NodeVector:
        """Bᵀ q of numbers in the box."""
        return self.divergence.transpose(self.box.outside(q))

    def solve_factor(self, r: Any) -> Any:
        raise NotImplementedError("VolumeInnerProduct has no factor; take that of factored().")

    def solve_factor_transpose(self, v: Any) -> Any:
        return self.solve_factor(v)
