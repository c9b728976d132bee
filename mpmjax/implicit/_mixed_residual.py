"""The linear solve of nearly incompressible bodies with averaged volumes, by a mixed form of its equation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, Scalar
from mpmjax.checks import require, require_fields, require_tolerance
from mpmjax.discretisation import gather
from mpmjax.implicit._conjugate_residual import ConjugateResidual
from mpmjax.implicit._hessian_action import ParticleStiffness
from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._linear_solve import NEARLY_CONVERGED, AbstractInnerProductSolver, default_rtol
from mpmjax.implicit._operator import AbstractSymmetricOperator, ImplicitOperator

Fields = tuple[NodeVector, tuple[NodeScalar, ...], tuple[NodeScalar, ...]]
"""v, and θ and q of each averaged material."""


class MixedResidual(AbstractInnerProductSolver[lx.AbstractLinearOperator]):
    """`ConjugateResidual` for bodies with averaged volumes, in a number of iterations that does not grow as ν nears ½.

    With averaged volumes M + χH = A + χ (Bᵀ D B + Bᵀ C + Cᵀ B), where A is the matrix without the change of mean
    volumes and θ = B v are the nodes' mean volumes (see `AveragedStiffness`). The same v solves

        ⎡ A    χCᵀ   χBᵀ ⎤ ⎡ v ⎤   ⎡ b ⎤
        ⎢ χC   χD   −χI  ⎥ ⎢ θ ⎥ = ⎢ 0 ⎥
        ⎣ χB  −χI    0   ⎦ ⎣ q ⎦   ⎣ 0 ⎦

    with pressures q: symmetric and indefinite, as the conjugate residual method allows. The bulk modulus stands in D
    alone, whose diagonal is a good stand-in for it, so that with the diagonals of A, D and B A⁻¹ Bᵀ for inner product
    the spread of the eigenvalues has a bound without the bulk modulus (M. Benzi, G. H. Golub, J. Liesen, Acta Numer. 14
    (2005) 1, doi 10.1017/S0962492904000212, section 10). The residual that ends it is that of M + χH, as of the plain
    method: the mixed system is solved again for what is left, at most `most_rounds` times.

    Where no volumes are averaged it is the plain method. It takes operators of this package alone.

    Args:
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32.
        max_steps: largest number of steps in each round.
        most_rounds: largest number of rounds.
    """

    rtol: Scalar | None = None
    max_steps: int = eqx.field(static=True, default=1000)
    most_rounds: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        require_fields(self)
        if self.rtol is not None:
            require_tolerance("MixedResidual's rtol", self.rtol)
        for name, number in (("max_steps", self.max_steps), ("most_rounds", self.most_rounds)):
            require(number >= 1, f"MixedResidual's {name} must be at least 1, got {number}.")

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        return ConjugateResidual().init(operator, options)

    def compute(
        self, state: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
    ) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        plain = ConjugateResidual(self.rtol, max_steps=self.max_steps)
        hessian = state.hessian if isinstance(state, ImplicitOperator) else None
        if not isinstance(hessian, ParticleStiffness) or not hessian.averaged:
            return plain.compute(state, vector, options)
        rtol = default_rtol(vector.dtype) if self.rtol is None else self.rtol
        return _solve_mixed(self, _MixedOperator(state), vector, options["inner_product"], options.get("y0"), rtol)

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


class _Rounds(eqx.Module):
    x: NodeVector
    r: NodeVector
    left: Float[Array, ""]
    steps: Int[Array, ""]
    rounds: Int[Array, ""]
    radius: Float[Array, ""]
    stalled: Bool[Array, ""]


def _solve_mixed(
    solver: MixedResidual,
    mixed: "_MixedOperator",
    vector: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None,
    rtol: Scalar,
) -> tuple[NodeVector, lx.RESULTS, dict[str, Any]]:
    """Rounds of the mixed system for what is left of the residual b − (M + χH) x."""
    whole, weights = mixed.operator, mixed.weights()
    within = ConjugateResidual(solver.rtol, max_steps=solver.max_steps)

    def size(r: NodeVector) -> Float[Array, ""]:
        return jnp.sqrt((r * inner.solve(r)).sum())

    def goes_on(c: _Rounds) -> Bool[Array, ""]:
        return (c.left > rtol * scale) & ~c.stalled & (c.rounds < solver.most_rounds)

    def again(c: _Rounds) -> _Rounds:
        rhs = (c.r, *(tuple(jnp.zeros_like(q) for q in part) for part in weights[1:]))
        options = {"inner_product": DiagonalInnerProduct(weights)}
        (dx, *_), _, stats = within.compute(mixed, rhs, options)
        x = c.x + dx
        r = vector - whole.mv(x)
        left = size(r)
        better = left < c.left
        return _Rounds(
            x=jnp.where(better, x, c.x),
            r=jnp.where(better, r, c.r),
            left=jnp.where(better, left, c.left),
            steps=c.steps + stats["num_steps"],
            rounds=c.rounds + 1,
            radius=jnp.maximum(c.radius, stats["spectral_radius"]),
            stalled=~(left < c.left / 2),
        )

    scale = size(vector)
    start = jnp.zeros_like(vector) if guess is None else guess
    first = vector - whole.mv(start)
    none = jnp.asarray(0, dtype=jnp.int32)
    zero = jnp.zeros((), vector.dtype)
    c = jax.lax.while_loop(
        goes_on, again, _Rounds(start, first, size(first), none, none, zero, jnp.asarray(False))
    )
    residual = c.left / jnp.where(scale == 0, 1, scale)
    converged = c.left <= rtol * scale
    stopped = lx.RESULTS.where(c.stalled, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
    stopped = lx.RESULTS.where(jnp.isfinite(residual), stopped, lx.RESULTS.nonfinite_input)
    return (
        c.x,
        lx.RESULTS.where(converged, lx.RESULTS.successful, stopped),
        {
            "num_steps": c.steps,
            "max_steps": solver.max_steps * solver.most_rounds,
            "residual": residual,
            "spectral_radius": c.radius,
            "indefinite": jnp.asarray(False),
            "nearly_converged": ~converged & (c.left <= NEARLY_CONVERGED * rtol * scale),
        },
    )


class _MixedOperator(AbstractSymmetricOperator):
    """The matrix of the mixed system."""

    operator: ImplicitOperator

    @property
    def stiffness(self) -> ParticleStiffness:
        """H."""
        hessian = self.operator.hessian
        assert isinstance(hessian, ParticleStiffness)
        return hessian

    def is_positive_semidefinite(self) -> bool:
        return False

    def in_structure(self) -> Any:
        node = jax.ShapeDtypeStruct(self.operator.mass.shape, self.operator.mass.dtype)
        each = tuple(node for _ in self.stiffness.averaged)
        return self.operator.in_structure(), each, each

    def mv(self, vector: Fields) -> Fields:
        v, means, pressures = vector
        H, factor, combine = self.stiffness, self.operator.factor, self.operator.projection.combine
        free = combine(v, 0)
        _, slopes = moved = gather(H.stencil, H.mirror.unfold(free))
        flux, by_mean, by_pressure = jnp.zeros_like(slopes), [], []
        for one, mean, pressure in zip(H.averaged, means, pressures, strict=True):
            rows = slice(*one.rows)
            g, at = slopes[..., rows], one.average.at_particles(mean)
            push = one.average.at_particles(one.average.inverse * pressure)
            flux = flux.at[..., rows].add(one.coupling * at + one.volumetric * push)
            inside = one.average.inverse > 0
            strain = one.average.at_nodes(la.double_dot(one.coupling, g) + one.bulk * at)
            opened = one.average.inverse * one.average.at_nodes(la.double_dot(one.volumetric, g))
            by_mean.append(jnp.where(inside, factor * (strain - pressure), mean))
            by_pressure.append(jnp.where(inside, factor * (opened - mean), pressure))
        top = self.operator.mass[:, None] * free + factor * H.of_moved(free, moved, [flux])
        top = combine(top, self.operator.projection.identity_rows(v, self.operator.mass))
        return top, tuple(by_mean), tuple(by_pressure)

    def weights(self) -> Fields:
        """The diagonals of A and D, and about that of B A⁻¹ Bᵀ: Σ_i B_ai²/A_ii is at most the average of
        Σ_i g_ip²/A_ii over the particles."""
        H, factor, project = self.stiffness, self.operator.factor, self.operator.projection
        own = self.operator.nodal_mass()
        own = own + factor * H.without_averages().diagonal(own)
        empty = own <= 0
        light = jnp.where(empty, 0, 1 / jnp.where(empty, 1, own))
        light = jnp.stack([H.mirror.unfold_scalar(component) for component in light.T], axis=1)
        _, reach = gather(H.stencil.squared, light)
        means, pressures = [], []
        for one in H.averaged:
            inside, volume = one.average.inverse > 0, one.average.volume
            stiff = one.average.at_nodes(jnp.abs(one.bulk))
            square = (one.volumetric / volume) ** 2
            soft = la.double_dot(square, reach[..., slice(*one.rows)])
            soft = one.average.inverse * one.average.at_nodes(volume * soft)
            means.append(jnp.where(inside, factor * jnp.where(stiff > 0, stiff, 1), 1))
            pressures.append(jnp.where(inside, _SHARE * factor**2 * jnp.where(soft > 0, soft, 1), 1))
        return project.commuting_weight(own), tuple(means), tuple(pressures)


_SHARE = 0.3
"""Of the bound on the diagonal of B A⁻¹ Bᵀ that is taken for it."""
