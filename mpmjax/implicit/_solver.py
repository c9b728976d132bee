"""The conjugate residual method, natively where the library can; the door to other solvers; the report of a solve."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree

from mpmjax._types import Array, Bool, Float, Int, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import positive, require_fields, tolerance, whole
from mpmjax.discretisation import Basis, basis_attributes, resist_sum, without_flat
from mpmjax.implicit._operator import (
    AbstractInnerProduct,
    AbstractInnerProductSolver,
    DiagonalInnerProduct,
    ImplicitOperator,
    SolveInfo,
    active_blocks,
    combine_onto,
    rest_of_product,
)
from mpmjax.implicit._potential import ParticleStiffness

DEFAULT_RTOL = {4: 1e-5, 8: 1e-8}  # the default relative tolerance, by bytes a number
NEARLY_CONVERGED = 10.0
"""A solve that ends within this many times its tolerance is accepted, and counted as less accurate. The error is
proportional to the residual, so seven of eight digits are left, or four of the five of float32."""
NEGLIGIBLE_CHANGE = 1e-3
"""Largest relative change of the solution by one more correction, where rounding hides the tolerance."""

_REACH = 64.0  # the recurrence's own residual means nothing below so many units of rounding of the one it started from


class ConjugateResidual(AbstractInnerProductSolver):
    """The conjugate residual method for a symmetric operator A, definite or not (E. Stiefel, Comment. Math. Helv. 29
    (1955) 157, doi 10.1007/BF02564277; the recurrence is derivation, eq. 19).

    It works on E = W⁻¹A in the inner product ⟨a, b⟩ = aᵀ W b, in which E is self-adjoint (derivation, eq. 18). With W
    the mass, E is the matrix I + βΔt²M⁻¹H of eq. 6, which is not symmetric in the plain inner product. The norm ‖r‖ of
    the residual r = W⁻¹(b − A x) never grows.

    It stops when ‖r‖ ≤ rtol ‖W⁻¹b‖ for the *true* residual. If rounding prevents that, the recurrence is restarted with
    the true residual as right-hand side until a restart no longer halves it. The result is then accepted if the last
    correction, which estimates the error, changed x by at most a thousandth in the norm of W. (A test of the residual
    would not do: in an ill-conditioned system it can be down to rounding while x is far off.) The residual that is
    returned shows how closely the tolerance was met.

    Options of `compute` are `inner_product`, that of W, an `AbstractInnerProduct` (default: W = I); `y0`, the initial
    guess (zeros); `rtol`, the tolerance of a solver that has none (that of the precision). Statistics:

    - `num_steps`: applications of E in the recurrence.
    - `residual`: the true ‖r‖/‖W⁻¹b‖.
    - `spectral_radius`: an estimate of ‖E‖.
    - `indefinite`: whether rᵀA r < 0 beyond rounding was met. A is then not positive definite, but not conversely.
    - `nearly_converged`: whether it did not converge, but came within ten times `rtol`.

    *When it breaks*: with an indefinite A the recurrence stops where rᵀA r = 0. The result is then
    `RESULTS.breakdown`.

    Args:
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32; 1e-6 there as an adjoint solver.
        increment_rtol: stop also when an increment is small, ‖α_k p_k‖² ≤ increment_rtol² ‖x‖². Default: not used. It
            says nothing of the residual.
        max_steps: largest number of steps of the recurrence.
    """

    rtol: Annotated[Scalar, tolerance] | None = None
    increment_rtol: Annotated[Scalar, positive] | None = None
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=1000)
    __check_init__ = require_fields

    def init(self, operator: Any, options: dict[str, Any]) -> Any:
        if not isinstance(operator, ImplicitOperator) and not lx.is_symmetric(operator):
            raise ValueError("ConjugateResidual needs a symmetric operator; tag it lineax.symmetric_tag if it is one.")
        if "preconditioner" in options:
            raise ValueError(
                "ConjugateResidual takes no preconditioner, which is an approximate inverse of the operator, but an "
                "inner product: options={'inner_product': W}, W an approximation of the operator itself."
            )
        return operator

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        b, unravel = ravel_pytree(vector)
        rtol = options.get("rtol", DEFAULT_RTOL[b.dtype.itemsize]) if self.rtol is None else self.rtol
        x = jnp.zeros_like(b) if options.get("y0") is None else ravel_pytree(options["y0"])[0]
        inner, size = options.get("inner_product"), b.size
        flat = lambda function: lambda u: ravel_pytree(function(unravel(u)))[0]  # noqa: E731
        if isinstance(inner, AbstractInnerProduct) and not isinstance(inner, DiagonalInnerProduct):
            space = paired(flat(state.mv), flat(inner.solve))
            b, x = jnp.stack([flat(inner.solve)(b), b]), jnp.stack([x, flat(inner.apply)(x)])
            end = conjugate_residual(space, b, x, rtol, self.max_steps, self.increment_rtol)
        else:
            weight = jnp.ones_like(b) if inner is None else ravel_pytree(inner.weight)[0]
            if isinstance(state, ImplicitOperator):
                active = active_blocks(state.projection.free.reshape(-1), b != 0, x != 0)
                product = lambda u: state.product(u, weight, active)  # noqa: E731
            else:
                active, multiply = active_blocks(jnp.ones(size, bool)), flat(state.mv)
                product = lambda u: ((image := multiply(u)) / weight, (u * image).sum())  # noqa: E731
            system = b / weight, x, rtol, self.max_steps
            if self.increment_rtol is None and isinstance(state, ImplicitOperator) and state.is_particle_matrices:
                end = solve_particle_matrices(state, weight, active, *system)
            else:
                end = conjugate_residual(diagonal(product, weight, active), *system, self.increment_rtol)
        result, stats = _outcome(end, rtol, self.max_steps)
        return unravel(end.x.reshape(-1, size)[0]), result, stats

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    conj = transpose

    def assume_full_rank(self) -> bool:
        return True


class Space(NamedTuple):
    """The operator and the inner product of the recurrence, for vectors in one of two forms."""

    product: Callable[[Array], Sequence[Array]]  # E u and uᵀA u of u
    dot: Callable[[Array, Array], Float[Array, ""]]  # aᵀ W c
    combine: Callable[..., Sequence[Array]]
    """a + s b, c + t d and ‖c + t d‖² of a, b, c, d, s, t. Results may take the memory of a and c with `onto` = 0, of b
    and d with 1."""


def diagonal(product: Callable[[Array], Sequence[Array]], weight: Array, active: Bool[Array, "k"]) -> Space:
    """Vectors with a diagonal W, zero outside of the active blocks, which are skipped."""

    dot = lambda a, c: (weight * a * c).sum()  # noqa: E731
    combine = lambda a, b, c, d, s, t, onto: combine_onto[onto](a, b, c, d, jnp.stack([s, t]), weight, active)  # noqa: E731
    return Space(product, dot, combine)


def paired(multiply: Callable[[Array], Array], solve: Callable[[Array], Array]) -> Space:
    """Vectors as pairs (v, W v), shape (2, m), with any W: a step then takes W⁻¹ once, and W never."""
    dot = lambda a, c: (a[1] * c[0]).sum()  # noqa: E731

    def product(u: Array) -> tuple[Array, Array]:
        image = multiply(u[0])
        return jnp.stack([solve(image), image]), (u[0] * image).sum()

    return Space(product, dot, lambda a, b, c, d, s, t, onto: [a + s * b, z := c + t * d, dot(z, z)])


class Iterate(NamedTuple):
    """An iterate in the letters of the derivation, eq. 19, and the state of its iteration. Norms are those of W."""

    x: Array
    rr: Float[Array, ""]  # ‖r‖²; of the true residual at the end
    k: Int[Array, ""]  # steps taken
    radius: Float[Array, ""]  # largest Rayleigh quotient |rᵀA r|/‖r‖²
    breakdown: Bool[Array, ""]  # whether rᵀA r = 0 to rounding was met
    indefinite: Bool[Array, ""]  # whether rᵀA r < 0 beyond rounding was met
    correction: Float[Array, ""]  # change of x since the last restart but one, an estimate of its error
    stalled: Bool[Array, ""]  # whether the true residual has not halved between the last two restarts
    b_norm: Float[Array, ""]  # ‖W⁻¹b‖
    x_norm: Any  # ‖x‖; None before the end
    small_increment: Bool[Array, ""] | bool = False  # whether the last one was within `increment_rtol`
    r: Any = None  # None, as the rest, where the library has iterated
    p: Any = None
    q: Any = None
    qq: Any = None  # ‖q‖²
    gamma: Any = None
    restart_rr: Any = None  # ‖r‖² at the last restart
    done: Any = None


def _while_loop(
    cond_fun: Callable[[Iterate], Array], body_fun: Callable[[Iterate], Iterate], first: Iterate
) -> Iterate:
    """`jax.lax.while_loop` with all scalars in one array: on a GPU each that a loop carries is a kernel of its own.

    In single precision it counts to 2²⁴."""
    split, dtype = partial(eqx.partition, filter_spec=jax.tree.map(lambda a: a.ndim == 0, first)), first.x.dtype
    some, tree = jax.tree.flatten(split(first)[0])
    pack = lambda c: ((parts := split(c))[1], jnp.stack([a.astype(dtype) for a in jax.tree.leaves(parts[0])]))  # noqa: E731
    cast = lambda numbers: [a.astype(b.dtype) for a, b in zip(numbers, some, strict=True)]  # noqa: E731
    unpack = lambda carry: eqx.combine(carry[0], jax.tree.unflatten(tree, cast(carry[1])))  # noqa: E731
    end = jax.lax.while_loop(lambda c: cond_fun(unpack(c)), lambda c: pack(body_fun(unpack(c))), pack(first))
    return unpack(end)


def conjugate_residual(
    space: Space, b: Array, x: Array, rtol: Scalar, max_steps: Scalar, increment_rtol: Scalar | None = None
) -> Iterate:
    """The solution of E x = b with b = W⁻¹ times the right-hand side, from the guess x, to ‖r‖ ≤ rtol ‖b‖, or to
    ‖α p‖ ≤ increment_rtol ‖x‖ if that is not None."""
    # Differences from the derivation:
    #
    # 1. E is applied at the head of the loop, which saves the last application.
    # 2. A step takes three sums over the vectors: ‖s‖² follows from ‖q‖², as the q are orthogonal.
    # 3. The recurrence's residual drifts from the true one, by ε‖E‖‖x‖ a step. Where it meets the tolerance, or is too
    #    small to be trusted, the true residual is computed. If that is not small enough, the recurrence restarts from
    #    it, until a restart no longer halves it.
    eps, max_steps, dot = jnp.finfo(b.dtype).eps, jnp.asarray(max_steps), space.dot
    b_norm = jnp.sqrt(dot(b, b))

    def cond_fun(c: Iterate) -> Bool[Array, ""]:
        steps_left = c.k.astype(max_steps.dtype) < max_steps
        return ~c.done & (jnp.sqrt(c.rr) > rtol * b_norm) & ~c.small_increment & ~c.breakdown & steps_left

    def body_fun(c: Iterate) -> Iterate:
        s, gamma = space.product(c.r)
        beta = gamma / c.gamma
        p, q, qq = space.combine(c.r, c.p, s, c.q, beta, beta, onto=1)
        rounding = eps * jnp.sqrt(c.rr * (qq + beta**2 * c.qq))  # of γ: ε‖r‖‖s‖
        breakdown = jnp.abs(gamma) <= rounding
        alpha = jnp.where(breakdown, 0, gamma / jnp.where(breakdown, 1, qq))
        x, r, rr = space.combine(c.x, p, c.r, q, alpha, -alpha, onto=0)
        small_increment = c.small_increment
        if increment_rtol is not None:
            small_increment = ~breakdown & (alpha**2 * dot(p, p) <= increment_rtol**2 * dot(x, x))
        radius, indefinite = jnp.maximum(c.radius, jnp.abs(gamma) / c.rr), c.indefinite | (gamma < -rounding)
        c = c._replace(x=x, r=r, p=p, q=q, rr=rr, qq=qq, gamma=gamma, k=c.k + 1, radius=radius)
        return c._replace(small_increment=small_increment, breakdown=breakdown, indefinite=indefinite)

    def restart(c: Iterate) -> Iterate:
        r = b - space.product(c.x)[0]
        rr = dot(r, r)
        # an infinite γ makes the first β zero, so that p and q begin as r and s
        start = c._replace(r=r, p=zeros, q=zeros, rr=rr, qq=zero, gamma=infinite, restart_rr=rr)
        stalled = rr > c.restart_rr / 4
        start = start._replace(stalled=stalled, done=stalled | ~cond_fun(start))
        least = (_REACH * eps) ** 2 * rr
        end = _while_loop(lambda c: cond_fun(c) & (c.rr > least), body_fun, start)
        moved = end.x - c.x
        return end._replace(correction=jnp.where(end.done, c.correction, jnp.sqrt(dot(moved, moved))))

    zeros, zero, no = jnp.zeros_like(b), jnp.zeros_like(b_norm), jnp.zeros(b_norm.shape, bool)
    infinite, k = jnp.full_like(b_norm, jnp.inf), jnp.zeros(b_norm.shape, jnp.int32)
    first = Iterate(x, infinite, k, zero, no, no, infinite, no, b_norm, None, no)
    first = first._replace(r=zeros, p=zeros, q=zeros, qq=zero, gamma=infinite, restart_rr=infinite, done=no)
    end = _while_loop(lambda c: ~c.done, restart, first)
    return end._replace(x_norm=jnp.sqrt(dot(end.x, end.x)))


def _outcome(end: Iterate, rtol: Scalar, max_steps: int) -> tuple[lx.RESULTS, dict[str, Any]]:
    """The result and statistics of `ConjugateResidual.compute`."""
    residual, tolerance = jnp.sqrt(end.rr), rtol * end.b_norm
    ended_early, finite = end.k < max_steps, jnp.isfinite(residual)
    negligible = end.correction <= NEGLIGIBLE_CHANGE * end.x_norm
    exact = end.stalled & ~end.breakdown & ended_early & negligible
    converged = ((residual <= tolerance) | exact | end.small_increment) & finite
    result = lx.RESULTS.where(ended_early, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
    result = lx.RESULTS.where(end.breakdown, lx.RESULTS.breakdown, result)
    result = lx.RESULTS.where(finite, result, lx.RESULTS.nonfinite_input)
    result = lx.RESULTS.where(converged, lx.RESULTS.successful, result)
    return result, {
        "num_steps": end.k,
        "max_steps": max_steps,
        "residual": residual / jnp.where(end.b_norm == 0, 1, end.b_norm),
        "spectral_radius": end.radius,
        "indefinite": end.indefinite,
        "nearly_converged": ~converged & finite & (residual <= NEARLY_CONVERGED * tolerance),
    }


def solve_particle_matrices(
    operator: ImplicitOperator, weight: Array, active: Array, b: Array, x: Array, rtol: Scalar, max_steps: Scalar
) -> Iterate:
    """`conjugate_residual` with an operator that `is_particle_matrices` and a diagonal W, as a primitive. Rows that are
    not free are solved apart, so that no iteration needs to mask what moves.

    On CPUs the native library runs it as a whole, and in a batch each member by itself. A loop of JAX goes on for all
    members until the last one is done, and selects whole vectors in every step.
    """
    floor = (_REACH * jnp.finfo(b.dtype).eps) ** 2
    limits = jnp.stack([jnp.asarray(number, b.dtype) for number in (rtol, max_steps, floor)])
    hessian, free = operator.hessian, operator.projection.free.reshape(-1)
    assert isinstance(hessian, ParticleStiffness)
    stencil = hessian.stencil
    factor = jnp.asarray(operator.factor * stencil.slope**2, b.dtype)
    start, rhs = jnp.where(free, x, 0), jnp.where(free, b, 0)
    args = without_flat(stencil, hessian.upper), operator.mass, factor, free, weight, active, start, rhs, limits
    x, numbers = _solve(stencil.xi, *args, basis=stencil.basis)
    rr, k, radius, breakdown, indefinite, correction, stalled, b_norm, x_norm = numbers
    flags = breakdown > 0, indefinite > 0
    held = jnp.where(free, 0, b)
    x, rr = jnp.where(free, x, weight * b), rr + 0 * (weight * held * held).sum()  # NaN where a held row is not finite
    return Iterate(x, rr, k.astype(jnp.int32), radius, *flags, correction, stalled > 0, b_norm, x_norm)


def _call_solve(call: Any, xi: Array, *args: Array, basis: Basis) -> list[Array]:
    """By a kernel, with memory for five vectors. Members of a batch, one by one in a thread, take their own."""
    n, dtype = args[-2].shape[-1], xi.dtype
    results = [jax.ShapeDtypeStruct((size,), dtype) for size in (n, 9, 0 if xi.ndim > 2 else 5 * n)]
    aliases = {1 + len(args) - 3: 0}
    return call([xi, *args], basis_attributes(basis), results=results, aliases=aliases)[:2]


@partial(
    custom_derivative,
    kernel="solve",
    results=lambda *args, basis: (args[-2], jax.ShapeDtypeStruct((9,), args[-2].dtype)),
    call=_call_solve,
)
def _solve(xi: Array, *args: Array, basis: Basis) -> tuple[Array, Array]:
    """`solve_particle_matrices` of vectors that are zero where they are not free, written in JAX. Solves are not
    differentiated through their iterations."""
    upper, mass, factor, free, weight, active, x, b, limits = args

    def product(u: Array) -> tuple[Array, Array]:
        force = resist_sum(xi, upper, u.reshape(len(mass), -1), basis=basis).reshape(-1)
        return rest_of_product(force, u, mass, factor, free, weight, active)

    end = conjugate_residual(diagonal(product, weight, active), b, x, limits[0], limits[1])
    return end.x, jnp.stack([a.astype(b.dtype) for a in end[1:10]])


def solve_linear(
    solver: lx.AbstractLinearSolver,
    operator: ImplicitOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None = None,
    *,
    rtol: float | None = None,
) -> tuple[NodeVector, SolveInfo, Float[Array, ""]]:
    """Solve A x = b: x, the report, and a lower estimate of ‖W⁻¹A‖, 1 if the solver gives none.

    A solver that does not take an inner product is given the scaled system L⁻¹A L⁻ᵀ y = L⁻¹b/‖b‖ with W = L Lᵀ and
    x = ‖b‖ L⁻ᵀ y. It is symmetric and preconditioned, and its right-hand side has norm one, so that an absolute
    tolerance has no unit. The residual is computed here: a solution counts as converged only if that is within the
    tolerance too.

    Args:
        solver: a `lineax.AbstractLinearSolver` for symmetric operators.
        operator: A, precomputed.
        rhs: b.
        inner: the inner product of W.
        guess: where an iterative solver starts. Default: zero.
        rtol: the relative tolerance of a solver that takes an inner product and has none. Default: the precision's.

    Raises:
        ValueError: the solver refuses the operator, or returns no vector.
    """
    if isinstance(solver, AbstractInnerProductSolver):
        options = {"inner_product": inner} | {k: v for k, v in (("y0", guess), ("rtol", rtol)) if v is not None}
        state: Any = solver.init(operator, options)  # pyright: ignore[reportArgumentType]
        x, result, stats = solver.compute(state, rhs, options)
        info = SolveInfo(
            stats["num_steps"],
            residual=stats["residual"],
            converged=result == lx.RESULTS.successful,
            nearly_converged=stats["nearly_converged"],
            indefinite=stats["indefinite"],
            report=jnp.zeros_like(stats["residual"]),
        )
        return x, info, stats["spectral_radius"]

    name, inner, stiffness = type(solver).__name__, inner.factored(), operator.hessian
    definite = isinstance(stiffness, ParticleStiffness) and stiffness.is_positive_semidefinite()
    b = inner.solve_factor(rhs)
    size = jnp.sqrt((b**2).sum())
    size = jnp.where(size == 0, 1, size)
    b = b / size
    options = {} if guess is None else {"y0": inner.solve_factor(inner.apply(guess)) / size}
    multiply = lambda y: inner.solve_factor(operator.mv(inner.solve_factor_transpose(y)))  # noqa: E731
    tags = (lx.symmetric_tag, lx.positive_semidefinite_tag) if definite else lx.symmetric_tag
    scaled = lx.FunctionLinearOperator(multiply, operator.in_structure(), tags)
    try:
        state = solver.init(scaled, options)
    except ValueError as error:
        kind = "positive definite, without other structure. Take a solver of such matrices, as ConjugateResidual()"
        if not definite:
            kind = (
                "may be indefinite. Take a solver of such matrices, as ConjugateResidual(); or make it positive "
                "definite with AnalyticHessian(projected=True), which for the adjoint_solver of Newton's method is no "
                "way out, as its derivatives are those of the true Hessian"
            )
        raise ValueError(
            f"{name} refuses the matrix M + χH of an implicit step: {str(error).rstrip('.')}. The matrix is symmetric "
            f"and {kind}."
        ) from error
    y, result, stats = solver.compute(state, b, options)
    if jnp.shape(y) != b.shape:
        raise ValueError(
            f"{name}.compute must return a solution of the right-hand side's shape, {b.shape}, got {jnp.shape(y)}."
        )
    image = scaled.mv(y)
    residual = jnp.sqrt(((b - image) ** 2).sum())
    relative, atol = getattr(solver, "rtol", None), getattr(solver, "atol", None)
    tolerance = DEFAULT_RTOL[b.dtype.itemsize]
    if relative is not None or atol is not None:  # atol is of each component of a right-hand side of norm one
        tolerance = (0 if relative is None else relative) + math.sqrt(b.size) * (0 if atol is None else atol)
    converged = (result == lx.RESULTS.successful) & (residual <= tolerance)
    info = SolveInfo(
        jnp.asarray(stats.get("num_steps", 0), dtype=jnp.int32),
        residual=residual,
        converged=converged,
        nearly_converged=~converged & (residual <= NEARLY_CONVERGED * tolerance),
        indefinite=(y * image).sum() < 0,
        report=jnp.zeros_like(residual),
    )
    return size * inner.solve_factor_transpose(y), info, jnp.ones_like(residual)
