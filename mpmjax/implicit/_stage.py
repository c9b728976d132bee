"""An implicit stage: its equation, the ways to solve it, and the one rule for the derivative of all of them. At the end
Newton's method.

The derivative of the solution v of residual(v) = 0 is that of the implicit function theorem (derivation, eq. 30), and
in reverse mode its transpose (eq. 31): one more solve with the same operator. Iterations are never differentiated.
"""

import abc
import enum
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative, saved_for_backward, without_derivative
from mpmjax.checks import require_fields, tolerance, whole
from mpmjax.implicit._operator import AbstractPreconditioner, ImplicitOperator, Projection, SolveInfo, require_solver
from mpmjax.implicit._potential import AbstractHessian, AbstractHessianAction, ElasticPotential
from mpmjax.implicit._solver import DEFAULT_RTOL, NEARLY_CONVERGED, NEGLIGIBLE_CHANGE, ConjugateResidual, solve_linear

_DERIVATIVE_RTOL = 1e-6
"""Largest default relative tolerance of tangent and adjoint solves. In float32 it is smaller than that of a step: in
slow motion of stiff bodies the stiff parts of the right-hand side cancel, and the derivative's error is some hundred
times the tolerance."""


class Guess(enum.Enum):
    """The initial guess of an implicit solve.

    v*, the result of an explicit step, is far off at a hundred times the explicit limit.
    """

    GRID_VELOCITY = "grid velocity"
    """v^n, the velocity of the nodes before the step. The default."""
    EXPLICIT = "explicit"
    """v*, the explicitly updated velocity (derivation, eq. 4)."""
    ZERO = "zero"  # zero velocity


class StageProblem(eqx.Module):
    """M (v − a) = Δt_s (f(u + θΔt_s v) − θ D v), an equation for the velocity v of the nodes [m/s], shape (n, d), in a
    stage of length Δt_s. f(u) is the elastic force at a nodal displacement u and −D v the viscous force.

    Stages have θ = 1 (derivation, eq. 22 and section 10); backward Euler is one with Δt_s = Δt, u = 0 and
    a = v^n + Δt g. The semi-implicit step has θ = β (eq. 3). Held components of v have the value of `prescribed`.

    The equation is M (v − a) − Δt_s f(u + θΔt_s v) = 0, the left side being the gradient of the incremental potential
    𝓔(v) = ½ ‖v − a‖²_M + Φ(u + θΔt_s v)/θ (eq. 23). Viscosity adds θΔt_s D v to it and ½ θΔt_s v·D v to the potential.
    In a linearised problem f(u) is f(0) − H u and the equation (M + χ H) v = b with χ = θΔt_s² (eq. 17).
    """

    mass: NodeScalar  # nodal masses m_i [kg], shape (n,)
    inertial: NodeVector  # a [m/s], the velocity of the stage without the force at its own end, shape (n, d)
    stage_dt: Float[Array, ""]  # Δt_s [s], the length of the stage
    initial_displacement: NodeVector | None  # u [m], shape (n, d); None for zero
    force: NodeVector  # f(0) [N], shape (n, d); in a linearised problem f(0) − H u
    spacing: Float[Array, ""]  # grid spacing dx [m]
    potential: ElasticPotential  # Φ, with f = −∂Φ/∂u
    hessian: AbstractHessian  # H = ∂²Φ/∂u∂u [N/m], exactly or approximately
    projection: Projection  # the projection on free components
    prescribed: NodeVector | None  # the velocity of held components [m/s], shape (n, d); None if they are at rest
    preconditioner: AbstractPreconditioner  # W
    theta: Scalar = 1.0  # θ [-], the share of the stage's displacement at which its force is evaluated
    action: AbstractHessianAction | None = None  # H at the start of the step in a linearised problem; None in others

    def operator(self, v: NodeVector, hessian: AbstractHessian | None = None) -> ImplicitOperator:
        """M + θΔt_s D + θΔt_s² H at v, the derivative of `residual`.

        Args:
            v: v [m/s], shape (n, d); a linearised problem has one operator, whatever it is.
            hessian: an approximation of H in a problem that is not linearised. Default: H without approximation.
        """
        action = self.action
        if action is None:
            action = (hessian or self.hessian.exact()).at(self.potential, self.displacement(v))
        viscosity = (self.potential, 1 / self.stage_dt) if self.potential.viscous else None
        return ImplicitOperator(self.mass, self.theta * self.stage_dt**2, action, self.projection, viscosity)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """The residual of momentum at each node [kg m/s], shape (n, d); in held components, the impulse that holds."""
        if self.action is None:
            force = self.potential.force(self.displacement(v))
        else:
            force = self.force - self.action(self.theta * self.stage_dt * v)
        if self.potential.viscous:
            force = force - self.theta * self.potential.viscous_resistance(v)
        return self.mass[:, None] * (v - self.inertial) - self.stage_dt * force

    def residual(self, v: NodeVector) -> NodeVector:
        """The momentum residual in free components, and v − prescribed in held ones. Its Jacobian is symmetric."""
        return self.projection.combine(self.momentum_residual(v), v if self.prescribed is None else v - self.prescribed)

    def apply_dirichlet(self, guess: NodeVector) -> NodeVector:
        """The guess, with the prescribed values in held components."""
        return self.projection.combine(guess, 0 if self.prescribed is None else self.prescribed)

    def displacement(self, v: NodeVector) -> NodeVector:
        """u + θΔt_s v [m]."""
        moved = self.theta * self.stage_dt * v
        return moved if self.initial_displacement is None else self.initial_displacement + moved

    def undisplaced_velocity(self) -> NodeVector:
        """The velocity at which no node is displaced, −u/(θΔt_s) [m/s]."""
        if self.initial_displacement is None:
            return jnp.zeros_like(self.inertial)
        return -self.initial_displacement / (self.theta * self.stage_dt)

    def incremental_potential(self, v: NodeVector) -> Float[Array, ""]:
        """𝓔(v) [J] up to a constant, that of held components; NaN if a law does not admit the deformation."""
        free = self.projection.free
        inertia = 0.5 * jnp.where(free, self.mass[:, None] * (v - self.inertial) ** 2, 0).sum()
        if self.potential.viscous:
            inertia = inertia + self.theta * self.stage_dt / 2 * self.potential.power(v)
        return inertia + self.potential.admissible_energy(self.displacement(v)) / self.theta


class AbstractStageSolver(eqx.Module):
    """A way to solve the equation of a stage. A subclass must have `__call__`."""

    linearises: ClassVar[bool] = False
    """Whether it is given the problem with the elastic force f(0) − H u in place of that of the law."""

    @abc.abstractmethod
    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution [m/s], shape (n, d), and the report of the solve; an iteration starts at the guess [m/s], shape
        (n, d)."""


class Linearised(AbstractStageSolver):
    """One linear solve with the force f(0) − H u, linear in the displacement u of the step.

    Args:
        solver: linear solver, any symmetric one of lineax. Default: `ConjugateResidual` with default tolerances.
    """

    solver: Annotated[lx.AbstractLinearSolver, require_solver] = ConjugateResidual()
    linearises: ClassVar[bool] = True
    __check_init__ = require_fields

    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        return solve_linearised(self.solver, problem, guess)


def solve_linearised(
    solver: lx.AbstractLinearSolver, problem: StageProblem, guess: NodeVector
) -> tuple[NodeVector, SolveInfo]:
    """The solution of a linearised problem (M + χH) v = b [m/s], shape (n, d), and the report of the solve."""
    operator = problem.operator(guess).precomputed()
    combine = problem.projection.combine
    rhs, lift = problem.mass[:, None] * problem.inertial + problem.stage_dt * problem.force, None
    if problem.prescribed is not None:
        lift, at_rest = combine(0, problem.prescribed), rhs
        # walls at rest, the common case, spare one application of H
        rhs = jax.lax.cond((lift != 0).any(), lambda: at_rest - operator.unconstrained(lift), lambda: at_rest)
    inner = problem.preconditioner.inner_product(operator)
    v, info, _ = solve_linear(solver, operator, combine(rhs, 0), inner, combine(guess, 0))
    return v if lift is None else v + lift, info


class Reporting(eqx.Module):
    """The solver of tangent and adjoint systems, with a report of the solves that did not converge.

    These solves run inside of a derivative, so they can report only by derivatives of zeros: the tangent of `report` in
    forward mode, and the cotangent of `slot` in reverse mode. Either is the sum of the relative residuals of solves
    that did not converge, infinite if one is not finite. Such a solve gives NaN, and solves after it are not counted,
    so the sum is the residual of the first.
    """

    solver: lx.AbstractLinearSolver  # the solver of tangent and adjoint systems
    slot: Scalar  # zero


@custom_derivative
def solve(
    problem: StageProblem,
    slot: Array,
    guess: NodeVector,
    method: Callable[[StageProblem, NodeVector], tuple[NodeVector, SolveInfo]],
    adjoint: lx.AbstractLinearSolver,
) -> tuple[NodeVector, SolveInfo]:
    """The solution of a problem, differentiable with respect to it in forward and reverse mode, to any order.

    Args:
        problem, slot: the problem, and the slot of `Reporting`.
        guess: where the search starts [m/s], shape (n, d). Result and derivative depend on it only within the
            tolerance. No derivative passes it, nor what follows.
        method: how it is solved, as by an `AbstractStageSolver`.
        adjoint: solver of the tangent and adjoint systems. A solve that ends beyond ten times its tolerance gives NaN,
            so that a wrong gradient cannot pass for a right one.
    """
    return method(problem, guess)


@solve.defjvp
def _solve_jvp(primals: Any, tangents: Any) -> Any:
    problem, slot, guess, method, adjoint = primals
    d_problem, d_slot = tangents[:2]
    v, info = saved_for_backward(solve(problem, slot, guess, method, adjoint))
    d_residual = eqx.filter_jvp(lambda q: q.residual(v), (problem,), (d_problem,))[1]
    if d_residual is None:  # it does not depend on what is differentiated
        d_residual = jnp.zeros_like(v)
    operator = problem.operator(v)
    matrix, preconditioner = without_derivative((operator, problem.preconditioner))
    matrix = matrix.precomputed()
    inner = preconditioner.inner_product(matrix)

    def solve_symmetric(matvec: Any, b: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        del matvec  # the precomputed operator is the same map and faster
        rtol = min(DEFAULT_RTOL[b[0].dtype.itemsize], _DERIVATIVE_RTOL)
        x, report, _ = solve_linear(adjoint, matrix, b[0], inner, rtol=rtol)
        solved, finite = report.converged | report.nearly_converged, jnp.isfinite(b[0]).all()
        residual = jnp.where(jnp.isfinite(report.residual), report.residual, jnp.inf)
        return jnp.where(solved, x, jnp.nan), jnp.where(finite & ~solved, residual, 0)

    combine = problem.projection.combine
    rhs, lift = combine(-d_residual, 0), None
    if problem.prescribed is not None or problem.projection.normals:  # else it stays at rest
        lift = combine(0, -d_residual)
        rhs = combine(rhs - operator.unconstrained(lift), 0)
    # The second component reports the tangent solve: zero, or the residual of a solve that failed. It goes with the
    # first through one custom_linear_solve, so that the transposed solve reports likewise.
    d_slot = rhs[:0].sum() + (0 if d_slot is None else d_slot)  # a zero that keeps d_slot linear in the tangents

    def matvec(x: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        y = operator.mv(x[0])
        return y, x[1] + y[:0].sum()  # as above, of the next order's tangents

    dv, d_report = jax.lax.custom_linear_solve(matvec, (rhs, d_slot), solve_symmetric, symmetric=True)
    d_info = eqx.tree_at(lambda i: i.report, jax.tree.map(lambda _: None, info), d_report, is_leaf=lambda a: a is None)
    return (v, info), (dv if lift is None else dv + lift, d_info)


MOST_HALVINGS = 30
_SUFFICIENT_DECREASE = 1e-4
_ROUNDING = 4.0  # units of rounding that a sum over the particles and nodes is taken to have


class Newton(AbstractStageSolver):
    """Newton's method with a backtracking line search on the incremental potential.

    Direction: the Hessian can be indefinite. If the potential does not fall along Newton's direction, the steepest one
    in the norm of the preconditioner is taken.

    Line search: a step is halved until the decrease is at least 10⁻⁴ of what the slope predicts. The potential is not
    defined at deformations that a law does not admit, so these are avoided too.

    Start: the guess, or rest if the potential is lower there or the law does not admit the guess. If it does not admit
    rest either, because of prescribed velocities (a grip that closes a gap of one cell in a step), the first step is
    that of the linearised system. An equation that is not finite even there gives NaN.

    Termination: ‖residual‖ ≤ rtol ‖b‖ in the norm of the inverse mass. b is the right-hand side of the system
    linearised at zero displacement, without the contribution of prescribed velocities.

    Termination by rounding: b vanishes where forces balance, and in single precision it can be smaller than the
    rounding of the residual, 4 ε (‖W (|v| + dx/Δt_s)‖ + ‖M a‖) with W the diagonal of the operator and a of the stage
    (derivation, eq. 22). A residual below that rounding ends the iteration too, if one of two tests shows that the
    solution is good:

    - the last Newton step was taken whole, and changed v by at most a thousandth, or the strain by at most √ε, the
      energy of which is the rounding of the potential;
    - M + χH is not less than M, and the error ‖v − v*‖ ≤ ‖residual‖ is at most a thousandth of ‖v‖, in the norms of the
      mass and of its inverse.

    A guess is never accepted because of rounding alone.

    Args:
        solver: linear solver, any symmetric one of lineax. A loose tolerance suffices.
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32.
        max_steps: largest number of Newton steps.
    """

    solver: Annotated[lx.AbstractLinearSolver, require_solver] = ConjugateResidual(rtol=1e-3)
    rtol: Annotated[Scalar, tolerance] | None = None
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=30)
    __check_init__ = require_fields

    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        rtol = DEFAULT_RTOL[guess.dtype.itemsize] if self.rtol is None else self.rtol
        combine, free, potential = problem.projection.combine, problem.projection.free, problem.incremental_potential
        mass = jnp.where(free, problem.mass[:, None], 1)  # the weight of the norms in the termination rule
        # The velocity w = dx/(θΔt_s) strains a cell by one in the stage. Deformation gradients are of order one, and
        # rounded to ε, at the smallest strains too: with A the diagonal of the operator, ε A w is the rounding of the
        # momentum residual and ε A w² that of the potential.
        unit = problem.spacing / (problem.theta * problem.stage_dt)
        rounding_unit = _ROUNDING * jnp.finfo(guess.dtype).eps

        def norm(r: NodeVector) -> Float[Array, ""]:
            """‖r‖ in the norm of the inverse mass."""
            return jnp.sqrt((r**2 / mass).sum())

        def residual(v: NodeVector) -> NodeVector:
            return combine(problem.momentum_residual(v), 0)

        rest, start = problem.apply_dirichlet(jnp.zeros_like(guess)), problem.apply_dirichlet(guess)
        at_start, at_rest = potential(start), potential(rest)
        start = jnp.where(jnp.isfinite(at_start) & ~(at_rest < at_start), start, rest)
        startable = jnp.isfinite(at_start) | jnp.isfinite(at_rest)
        undisplaced = problem.undisplaced_velocity()
        b = problem.momentum_residual(undisplaced)
        b = combine(b + problem.operator(undisplaced).unconstrained(rest - undisplaced), 0)
        scale, inertia = norm(b), norm(combine(problem.mass[:, None] * problem.inertial, 0))

        def converged(c: _Iterate) -> Bool[Array, ""]:
            left = norm(c.r)
            speed = jnp.sqrt((mass * combine(c.v, 0) ** 2).sum())
            bounded = ~c.indefinite & (left <= NEGLIGIBLE_CHANGE * speed)
            return (left <= rtol * scale) | ((left <= c.rounding) & (c.settled | bounded))

        def cond_fun(c: _Iterate) -> Bool[Array, ""]:
            return ~converged(c) & (c.newton < self.max_steps) & ~c.stuck

        def body_fun(c: _Iterate) -> _Iterate:
            at = jnp.where((c.newton == 0) & ~startable, undisplaced, c.v)
            operator = problem.operator(at, problem.hessian).precomputed()
            inner = problem.preconditioner.inner_product(operator)
            # the direction: Newton's, or the steepest one where the potential does not fall along Newton's
            direction, solve, radius = solve_linear(self.solver, operator, -c.r, inner)
            slope = (c.r * direction).sum()
            steepest = inner.solve(-c.r) / jnp.maximum(radius, 1)
            uphill = ~(slope < 0)
            direction = jnp.where(uphill, steepest, direction)
            slope = jnp.where(uphill, (c.r * steepest).sum(), slope)
            # the line search
            energy = potential(c.v)
            energy = jnp.where(jnp.isfinite(energy), energy, jnp.inf)
            weight = jnp.where(free, operator.diagonal(), 0)
            slack = rounding_unit * ((weight * unit**2).sum() + jnp.abs(energy))
            size, halvings = backtrack(lambda size: potential(c.v + size * direction), energy, slope, slack)
            v = c.v + size * direction
            # whether the step changes the velocity by no more than a thousandth, or strains by no more than √ε
            unseen = jnp.where(free, jnp.sqrt(jnp.finfo(v.dtype).eps) * unit, 0)
            vectors = direction, combine(c.v + direction, 0), unseen
            moved, speed, least = (jnp.sqrt((inner.apply(a) * a).sum()) for a in vectors)
            negligible = moved <= jnp.maximum(NEGLIGIBLE_CHANGE * speed, least)
            return _Iterate(
                v=v,
                r=residual(v),
                rounding=rounding_unit * (norm(weight * (jnp.abs(v) + unit)) + inertia),
                settled=~uphill & solve.converged & (halvings == 0) & negligible,
                iterations=c.iterations + solve.iterations,
                newton=c.newton + 1,
                halvings=c.halvings + halvings,
                stuck=halvings >= MOST_HALVINGS,
                indefinite=c.indefinite | solve.indefinite,
            )

        none, zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), guess.dtype), jnp.zeros((), bool)
        first = _Iterate(start, jnp.where(startable, residual(start), b), zero, no, none, none, none, no, no)
        c = jax.lax.while_loop(cond_fun, body_fun, first)
        left = norm(c.r)
        size = jnp.maximum(jnp.maximum(scale, inertia), c.rounding)
        done = jnp.isfinite(left) & converged(c)
        info = SolveInfo(
            iterations=c.iterations,
            newton=c.newton,
            line_search=c.halvings,
            residual=left / jnp.where(size == 0, 1, size),
            converged=done,
            nearly_converged=~done & jnp.isfinite(left) & (left <= NEARLY_CONVERGED * rtol * scale),
            indefinite=c.indefinite,
            report=jnp.zeros_like(left),
        )
        return jnp.where(free & ~jnp.isfinite(left), jnp.nan, c.v), info


class _Iterate(NamedTuple):
    v: NodeVector
    r: NodeVector  # the residual at v
    rounding: Float[Array, ""]  # the rounding of ‖r‖
    settled: Bool[Array, ""]  # whether the last Newton step was taken whole and was negligible
    iterations: Int[Array, ""]
    newton: Int[Array, ""]
    halvings: Int[Array, ""]
    stuck: Bool[Array, ""]  # whether the last line search failed
    indefinite: Bool[Array, ""]


def backtrack(
    merit: Callable[[Float[Array, ""]], Float[Array, ""]],
    start: Float[Array, ""],
    slope: Float[Array, ""],
    slack: Float[Array, ""],
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """The first step size a of 1, ½, ¼, ... with sufficient decrease, E(a) ≤ E(0) + 10⁻⁴ a E'(0) + slack (L. Armijo,
    Pacific J. Math. 16 (1966) 1, doi 10.2140/pjm.1966.16.1), and the number of halvings, with E = `merit` [J],
    E(0) = `start` and E'(0) = `slope` < 0. At `MOST_HALVINGS` the search has failed.

    The slack is the rounding of E. Near a minimum the expected decrease is smaller than it, and without slack a good
    step would be refused. NaN is no decrease, so a step that leaves the domain of E is halved.
    """

    def refused(trial: tuple[Array, Array]) -> Bool[Array, ""]:
        size, halvings = trial
        decreased = merit(size) <= start + _SUFFICIENT_DECREASE * size * slope + slack
        return ~decreased & (halvings < MOST_HALVINGS)

    whole, zero_count = jnp.ones((), start.dtype), jnp.asarray(0, dtype=jnp.int32)
    return jax.lax.while_loop(refused, lambda trial: (trial[0] / 2, trial[1] + 1), (whole, zero_count))
