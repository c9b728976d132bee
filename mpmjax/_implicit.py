"""The nodal problems of the implicit updates, how each is solved, and one derivative rule for both.

A problem is an equation residual(v) = 0 for a velocity v of the nodes, the new one or that of a stage, with a symmetric
Jacobian. Whatever iteration finds v, its derivative is that of the implicit function theorem, J δv = −δ(residual): one
more solve with the same operator, forward or backward, so that no iteration is ever differentiated.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._checks import require, require_tolerance
from mpmjax._conjugate_residual import SETTLED, SHORT, ConjugateResidual, Reporting, default_rtol
from mpmjax._constraint import Constraint
from mpmjax._hessian import Hessian, ImplicitOperator, damped
from mpmjax._kinds import require_fields
from mpmjax._metric import Metric
from mpmjax._potential import ElasticPotential
from mpmjax._rule import ruled
from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, Scalar


class SolveInfo(eqx.Module):
    """What the solution of one step's system cost, and how good it is."""

    iterations: Int[Array, "*f"]
    """Conjugate-residual iterations, over all Newton steps."""
    newton: Int[Array, "*f"]
    """Newton steps."""
    line_search: Int[Array, "*f"]
    """Halvings of a Newton step by the line search."""
    residual: Float[Array, "*f"]
    """True relative residual at the end: of one linear solve in the norm of the inverse metric, of Newton's method in
    that of the inverse mass, and there relative to the momentum that the forces balance where their sum vanishes."""
    converged: Bool[Array, "*f"]
    """Whether the solver's tolerance, or the precision's own limit, was met."""
    short: Bool[Array, "*f"]
    """Whether neither was, but ten times the tolerance."""
    indefinite: Bool[Array, "*f"]
    """Whether the solver met a direction of negative curvature: M + cH is indefinite, and the step may be near a
    singular one."""
    report: Float[Array, "*f"]
    """Zero. Its tangent is the relative residual of the tangent solves that did not converge (see `Reporting`)."""

    def plus(self, later: "SolveInfo") -> "SolveInfo":
        """The cost of both solves and the quality of the later one."""
        return SolveInfo(
            iterations=self.iterations + later.iterations,
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            residual=later.residual,
            converged=later.converged,
            short=later.short,
            indefinite=self.indefinite | later.indefinite,
            report=self.report + later.report,
        )

    def beside(self, other: "SolveInfo") -> "SolveInfo":
        """The cost of both solves and the quality of the worse one."""
        both = self.plus(other)
        converged = self.converged & other.converged
        short = (self.converged | self.short) & (other.converged | other.short) & ~converged
        worst = jnp.maximum(self.residual, other.residual), converged, short
        return eqx.tree_at(lambda info: (info.residual, info.converged, info.short), both, worst)


def no_solve(dtype: Any) -> SolveInfo:
    """The report of an update that solves nothing."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    no, none = jnp.asarray(False), jnp.asarray(0, dtype=dtype)
    return SolveInfo(zero, zero, zero, none, converged=~no, short=no, indefinite=no, report=none)


class AbstractProblem(eqx.Module):
    """An equation for the nodes' velocity. What is held takes the value of `prescribed`."""

    constraint: eqx.AbstractVar[Constraint]
    prescribed: eqx.AbstractVar[NodeVector]

    @abc.abstractmethod
    def imbalance(self, v: NodeVector) -> NodeVector:
        """The momentum [kg m/s] by which each node misses its equation; on held nodes, the impulse that holds them."""

    @abc.abstractmethod
    def operator(self, v: NodeVector) -> ImplicitOperator:
        """The derivative of the imbalance at v, constrained."""

    def residual(self, v: NodeVector) -> NodeVector:
        """The equation that is solved: the imbalance of what is free, the error of what is prescribed."""
        return self.constraint.split(self.imbalance(v), v - self.prescribed)

    def admit(self, guess: NodeVector) -> NodeVector:
        """The guess with what is prescribed."""
        return self.constraint.split(guess, self.prescribed)


class LinearProblem(AbstractProblem):
    """(M + c H) v = b (reference, eq. 6 times m_i)."""

    mass: NodeScalar
    factor: Scalar
    hessian: Any
    rhs: NodeVector
    constraint: Constraint
    prescribed: NodeVector
    metric: Metric = eqx.field(static=True, default=Metric.MASS)

    def operator(self, v: NodeVector) -> ImplicitOperator:
        """Q (M + c H) Q + I − Q."""
        del v
        return ImplicitOperator(self.mass, self.factor, self.hessian, self.constraint, self.metric)

    def imbalance(self, v: NodeVector) -> NodeVector:
        """(M + c H) v − b."""
        return self.operator(v).unconstrained(v) - self.rhs


class NewtonProblem(AbstractProblem):
    """M (v − ṽ) − c f(u + c v) = 0: a stage of length c that starts at the displacement u. Backward Euler (reference,
    eq. 2) has c = Δt, u = 0, ṽ = v^n + Δt g.

    It is the gradient of the incremental potential E(v) = ½ ‖v − ṽ‖²_M + Φ(u + c v), of which a step that a wall or
    the line search accepts is a descent. Viscosity adds c D v to the one and ½ c v·D v to the other.
    """

    mass: NodeScalar
    inertial: NodeVector
    """ṽ [m/s]."""
    length: Float[Array, ""]
    """c [s]."""
    displaced: NodeVector | None
    """u [m]; None for zero."""
    spacing: Float[Array, ""]
    potential: ElasticPotential
    hessian: Hessian
    constraint: Constraint
    prescribed: NodeVector
    metric: Metric = eqx.field(static=True, default=Metric.MASS)

    def displacement(self, v: NodeVector) -> NodeVector:
        """u + c v [m]."""
        return self.length * v if self.displaced is None else self.displaced + self.length * v

    def undisplaced(self) -> NodeVector:
        """The velocity at which nothing is displaced, −u/c."""
        return jnp.zeros_like(self.inertial) if self.displaced is None else -self.displaced / self.length

    def operator(self, v: NodeVector) -> ImplicitOperator:
        """M + c D + c² H at the displacement, constrained: the derivative of the imbalance, H never projected."""
        return self._operator(self.hessian.exact(), v)

    def model(self, v: NodeVector) -> ImplicitOperator:
        """What a Newton step from v solves: the operator, or with a projected Hessian a positive definite stand-in."""
        return self._operator(self.hessian, v)

    def _operator(self, hessian: Hessian, v: NodeVector) -> ImplicitOperator:
        action = damped(hessian.at(self.potential, self.displacement(v)), self.potential, 1 / self.length)
        return ImplicitOperator(self.mass, self.length**2, action, self.constraint, self.metric)

    def imbalance(self, v: NodeVector) -> NodeVector:
        """M (v − ṽ) − c (f(u + c v) − D v)."""
        force = self.potential.force(self.displacement(v))
        if self.potential.viscous:
            force = force - self.potential.drag(v)
        return self.mass[:, None] * (v - self.inertial) - self.length * force

    def unit_strain(self) -> Float[Array, ""]:
        """The velocity dx/c [m/s] that strains a cell by one in the stage.

        Deformation gradients are of order one, and are rounded as such, however small the strains: so ε times this,
        times the operator's diagonal, is the rounding of the imbalance, and times itself that of the potential.
        """
        return self.spacing / self.length

    def merit(self, v: NodeVector) -> Float[Array, ""]:
        """E(v) [J], without the constant of what is held; NaN where a law is not defined."""
        free = self.constraint.free
        inertia = 0.5 * jnp.where(free, self.mass[:, None] * (v - self.inertial) ** 2, 0).sum()
        if self.potential.viscous:
            inertia = inertia + self.length / 2 * self.potential.power(v)
        return inertia + self.potential.admitted_energy(self.displacement(v))


class Linearised(eqx.Module):
    """One linear solve: the force is f(0) − H u in the whole step.

    Args:
        solver: of the linear system. Default: default tolerances.
    """

    solver: ConjugateResidual = ConjugateResidual()

    def __check_init__(self):
        require_fields(self)

    def __call__(self, problem: LinearProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution, started from a guess."""
        operator = problem.operator(guess).assembled()
        split = problem.constraint.split
        lift = split(0, problem.prescribed)
        rhs = split(problem.rhs - operator.unconstrained(lift), 0)
        options = {"metric": operator.metric(), "y0": split(guess, 0)}
        v, result, stats = self.solver.compute(self.solver.init(operator, options), rhs, options)
        converged = result == lx.RESULTS.successful
        rtol = default_rtol(rhs.dtype) if self.solver.rtol is None else self.solver.rtol
        info = SolveInfo(
            iterations=stats["num_steps"],
            newton=jnp.asarray(0, dtype=jnp.int32),
            line_search=jnp.asarray(0, dtype=jnp.int32),
            residual=stats["residual"],
            converged=converged,
            short=~converged & (stats["residual"] <= SHORT * rtol),
            indefinite=stats["indefinite"],
            report=jnp.zeros_like(stats["residual"]),
        )
        return v + lift, info


class Newton(eqx.Module):
    """Newton's method with a backtracking line search on the incremental potential.

    A direction along which the potential does not fall (the Hessian can be indefinite) is replaced by the steepest one
    in the metric's norm; a step is halved until the potential falls by a ten-thousandth of what its slope promises,
    which also keeps out of deformations where the law has no energy. Stops when ‖residual‖ ≤ rtol ‖b‖, b the right-hand
    side of the system linearised before anything moves, less what prescribed velocities contribute to it, both in the
    norm of the inverse mass.

    b vanishes where forces balance, and in single precision it can be smaller than the rounding of the residual, which
    is 4 ε (‖W (|v| + dx/c)‖ + ‖M ṽ‖), W the diagonal of the operator: that of the terms that were added, F's being of
    order one. A residual below that ends the iteration too, if the solution is known to be good in another way: the
    last Newton step, taken whole, changed v by no more than a thousandth or strained by no more than √ε, the energy of
    which is the potential's own rounding; or, M + cH being no less than M, the error ‖v − v*‖ ≤ ‖residual‖ is no more
    than a thousandth of ‖v‖, in the norms of the mass and of its inverse. No guess is accepted because of rounding
    alone.

    Starts from the guess, or from rest where the
    potential is lower there or the guess is a deformation for which the law has no energy; if that is so at rest too,
    for what is prescribed alone (a grip that closes a gap of one cell in a step), the first step is that of the
    linearised system. An equation that is not finite even there gives NaN, never rest.

    Args:
        solver: of the linear systems; a loose tolerance suffices.
        rtol: relative tolerance. Default: that of the precision, 1e-8 or 1e-5.
        max_steps: most Newton steps.
    """

    solver: ConjugateResidual = ConjugateResidual(rtol=1e-3)
    rtol: Scalar | None = None
    max_steps: int = eqx.field(static=True, default=30)

    def __check_init__(self):
        require_fields(self)
        if self.rtol is not None:
            require_tolerance("Newton's rtol", self.rtol)
        require(self.max_steps >= 1, f"Newton's max_steps must be at least 1, got {self.max_steps}.")

    def __call__(self, problem: NewtonProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution, started from a guess."""
        split, free = problem.constraint.split, problem.constraint.free
        metric = jnp.where(free, problem.mass[:, None], 1)
        unit_strain = problem.unit_strain()
        dtype = guess.dtype
        eps = jnp.finfo(dtype).eps
        rtol = default_rtol(dtype) if self.rtol is None else self.rtol

        def norm(r: NodeVector) -> Float[Array, ""]:
            return jnp.sqrt((r**2 / metric).sum())

        def residual(v: NodeVector) -> NodeVector:
            return split(problem.imbalance(v), 0)

        def converged(c: _NewtonState) -> Bool[Array, ""]:
            left, speed = norm(c.r), jnp.sqrt((metric * split(c.v, 0) ** 2).sum())
            bounded = ~c.indefinite & (left <= SETTLED * speed)
            return (left <= rtol * scale) | ((left <= c.rounding) & (c.settled | bounded))

        def goes_on(c: _NewtonState) -> Array:
            return ~converged(c) & (c.newton < self.max_steps) & ~c.stuck

        def step(c: _NewtonState) -> _NewtonState:
            model = problem.model(jnp.where((c.newton == 0) & ~startable, still, c.v)).assembled()
            inner = model.metric()
            options = {"metric": inner}
            direction, result, stats = self.solver.compute(self.solver.init(model, options), -c.r, options)
            slope = (c.r * direction).sum()
            steepest = -c.r / inner / jnp.maximum(stats["spectral_radius"], 1)
            uphill = ~(slope < 0)
            whole = ~uphill & (result == lx.RESULTS.successful)
            direction = jnp.where(uphill, steepest, direction)
            slope = jnp.where(uphill, (c.r * steepest).sum(), slope)
            energy = problem.merit(c.v)
            energy = jnp.where(jnp.isfinite(energy), energy, jnp.inf)
            weight = jnp.where(free, model.diagonal(), 0)
            slack = _ROUNDING * eps * ((weight * unit_strain**2).sum() + jnp.abs(energy))  # in it the fall drowns
            unseen = jnp.where(free, jnp.sqrt(eps) * unit_strain, 0)
            steps = direction, split(c.v + direction, 0), unseen
            moved, speed, least = (jnp.sqrt((inner * a**2).sum()) for a in steps)

            def too_high(trial: tuple[Array, Array]) -> Array:
                length, count = trial
                fallen = problem.merit(c.v + length * direction) <= energy + 1e-4 * length * slope + slack
                return ~fallen & (count < _MOST_HALVINGS)

            one, zero = jnp.ones((), dtype), jnp.asarray(0, dtype=jnp.int32)
            length, halvings = jax.lax.while_loop(too_high, lambda a: (a[0] / 2, a[1] + 1), (one, zero))
            v = c.v + length * direction
            return _NewtonState(
                v=v,
                r=residual(v),
                rounding=_ROUNDING * eps * (norm(weight * (jnp.abs(v) + unit_strain)) + inertia),
                settled=whole & (halvings == 0) & (moved <= jnp.maximum(SETTLED * speed, least)),
                iterations=c.iterations + stats["num_steps"],
                newton=c.newton + 1,
                halvings=c.halvings + halvings,
                stuck=halvings >= _MOST_HALVINGS,
                indefinite=c.indefinite | stats["indefinite"],
            )

        lift = split(0, problem.prescribed)
        start = problem.admit(guess)
        energies = problem.merit(start), problem.merit(lift)
        start = jnp.where(jnp.isfinite(energies[0]) & ~(energies[1] < energies[0]), start, lift)
        startable = jnp.isfinite(energies[0]) | jnp.isfinite(energies[1])
        zero = jnp.asarray(0, dtype=jnp.int32)
        still = problem.undisplaced()
        linearised = problem.imbalance(still) + problem.operator(still).unconstrained(lift - still)
        linearised = split(linearised, 0)
        scale, inertia = norm(linearised), norm(split(problem.mass[:, None] * problem.inertial, 0))
        no = jnp.asarray(False)
        first = jnp.where(startable, residual(start), linearised)
        state = _NewtonState(start, first, jnp.zeros((), dtype), no, zero, zero, zero, no, no)
        c = jax.lax.while_loop(goes_on, step, state)
        left, size = norm(c.r), jnp.maximum(jnp.maximum(scale, inertia), c.rounding)
        done = jnp.isfinite(left) & converged(c)
        info = SolveInfo(
            iterations=c.iterations,
            newton=c.newton,
            line_search=c.halvings,
            residual=left / jnp.where(size == 0, 1, size),
            converged=done,
            short=~done & (left <= SHORT * rtol * scale),
            indefinite=c.indefinite,
            report=jnp.zeros_like(left),
        )
        return jnp.where(free & ~jnp.isfinite(left), jnp.nan, c.v), info


_MOST_HALVINGS = 30
_ROUNDING = 4.0  # units of it


class _NewtonState(eqx.Module):
    v: NodeVector
    r: NodeVector
    rounding: Array
    """Of ‖r‖."""
    settled: Array
    """Whether the last Newton step was whole, and too small to matter."""
    iterations: Array
    newton: Array
    halvings: Array
    stuck: Array
    indefinite: Array


def solve(
    problem: AbstractProblem, guess: NodeVector, find: Linearised | Newton, adjoint: ConjugateResidual | Reporting
) -> tuple[NodeVector, SolveInfo]:
    """The solution of a problem, differentiable with respect to it in forward and reverse mode, to any order.

    Args:
        problem: the problem.
        guess: where the iteration starts; the result does not depend on it beyond the tolerance, nor its derivative.
        find: the iteration.
        adjoint: solver of the tangent and adjoint systems. One that does not converge gives NaN derivatives, so that a
            wrong gradient cannot pass for a right one.
    """
    if not isinstance(adjoint, Reporting):
        adjoint = Reporting(adjoint, jnp.zeros((), guess.dtype))
    return _solve(problem, adjoint.slot, *jax.lax.stop_gradient((guess, find, adjoint.solver)))


@ruled
def _solve(
    problem: AbstractProblem, slot: Array, guess: NodeVector, find: Any, adjoint: ConjugateResidual
) -> tuple[NodeVector, SolveInfo]:
    del slot, adjoint
    return find(problem, guess)


@_solve.defjvp
def _solve_jvp(primals: Any, tangents: Any) -> Any:
    problem, slot, guess, find, adjoint = primals
    d_problem, d_slot = tangents[:2]
    v, info = _solve(problem, slot, guess, find, adjoint)
    d_residual = eqx.filter_jvp(lambda q: q.residual(v), (problem,), (d_problem,))[1]
    operator = problem.operator(v)
    assembled = jax.lax.stop_gradient(operator).assembled()
    options = {"metric": assembled.metric()}

    def solve_symmetric(matvec: Any, b: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        del matvec  # the same operator, slower
        x, result, stats = adjoint.compute(adjoint.init(assembled, options), b[0], options)
        solved, known = result == lx.RESULTS.successful, jnp.isfinite(b[0]).all()
        residual = jnp.where(jnp.isfinite(stats["residual"]), stats["residual"], jnp.inf)
        return jnp.where(solved, x, jnp.nan), jnp.where(known & ~solved, residual, 0)

    split = problem.constraint.split
    lift = split(0, -d_residual)
    rhs = split(-d_residual - operator.unconstrained(lift), 0)
    d_slot = rhs[:0].sum() + (0 if d_slot is None else d_slot)  # linear in tangents also where nobody listens
    dv, d_report = jax.lax.custom_linear_solve(
        lambda x: (operator.mv(x[0]), x[1]), (rhs, d_slot), solve_symmetric, symmetric=True
    )
    d_info = eqx.tree_at(lambda i: i.report, jax.tree.map(lambda _: None, info), d_report, is_leaf=lambda a: a is None)
    return (v, info), (dv + lift, d_info)
