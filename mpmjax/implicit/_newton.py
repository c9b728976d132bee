"""Newton's method for the nodal problems."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector, Scalar
from mpmjax.checks import require, require_fields, require_tolerance
from mpmjax.implicit._conjugate_residual import NEGLIGIBLE_CHANGE, ConjugateResidual
from mpmjax.implicit._inner_product import AbstractInnerProduct
from mpmjax.implicit._linear_solve import NEARLY_CONVERGED, default_rtol, require_solver, solve_linear
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._solution import AbstractSolution, SolveInfo
from mpmjax.implicit._stage_problem import StageProblem

MOST_HALVINGS = 30
_SUFFICIENT_DECREASE = 1e-4
_ROUNDING = 4.0  # units of rounding that a sum over the particles and nodes is taken to have


class Newton(AbstractSolution):
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

    solver: lx.AbstractLinearSolver = ConjugateResidual(rtol=1e-3)
    rtol: Scalar | None = None
    max_steps: int = eqx.field(static=True, default=30)

    def __check_init__(self):
        require_fields(self)
        require_solver("Newton's solver", self.solver)
        if self.rtol is not None:
            require_tolerance("Newton's rtol", self.rtol)
        require(self.max_steps >= 1, f"Newton's max_steps must be at least 1, got {self.max_steps}.")

    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        rtol = default_rtol(guess.dtype) if self.rtol is None else self.rtol
        setting, start = _setting(problem, guess, rtol)

        def goes_on(c: _NewtonState) -> Bool[Array, ""]:
            return ~_converged(setting, c) & (c.newton < self.max_steps) & ~c.stuck

        c = jax.lax.while_loop(goes_on, partial(_step, self.solver, setting), start)
        return _outcome(setting, c)


class _Setting(eqx.Module):
    """The constants of an iteration."""

    problem: StageProblem
    rtol: Scalar
    mass: NodeVector
    """Nodal masses [kg], 1 in components that are not free: the weight of the norms in the termination rule."""
    scale: Float[Array, ""]
    """‖b‖, with b the right-hand side of the system linearised at zero displacement."""
    inertia: Float[Array, ""]
    """‖M a‖, with a of the stage."""
    undisplaced: NodeVector
    """The velocity at which nothing is displaced [m/s]."""
    startable: Bool[Array, ""]
    """Whether the potential is defined at the guess or at rest."""

    def residual(self, v: NodeVector) -> NodeVector:
        """The momentum residual, zero in components that are held."""
        return self.problem.projection.combine(self.problem.momentum_residual(v), 0)

    def norm(self, r: NodeVector) -> Float[Array, ""]:
        """‖r‖ in the norm of the inverse mass."""
        return _norm(r, self.mass)


class _NewtonState(eqx.Module):
    v: NodeVector
    r: NodeVector
    """The residual at v."""
    rounding: Float[Array, ""]
    """The rounding of ‖r‖."""
    settled: Bool[Array, ""]
    """Whether the last Newton step was taken whole and was negligible."""
    iterations: Int[Array, ""]
    newton: Int[Array, ""]
    halvings: Int[Array, ""]
    stuck: Bool[Array, ""]
    """Whether the last line search failed."""
    indefinite: Bool[Array, ""]


class _Direction(eqx.Module):
    """The direction of a Newton step, and the report of its linear solve."""

    value: NodeVector
    slope: Float[Array, ""]
    """Derivative of the potential along it."""
    whole: Bool[Array, ""]
    """Whether it is Newton's direction, from a solve that converged."""
    iterations: Int[Array, ""]
    indefinite: Bool[Array, ""]


def _setting(problem: StageProblem, guess: NodeVector, rtol: Scalar) -> tuple[_Setting, _NewtonState]:
    """The constants and the initial state of an iteration."""
    combine, free = problem.projection.combine, problem.projection.free
    rest = problem.apply_dirichlet(jnp.zeros_like(guess))
    start = problem.apply_dirichlet(guess)
    energies = problem.incremental_potential(start), problem.incremental_potential(rest)
    start = jnp.where(jnp.isfinite(energies[0]) & ~(energies[1] < energies[0]), start, rest)
    undisplaced = problem.undisplaced_velocity()
    linearised = problem.momentum_residual(undisplaced)
    linearised = combine(linearised + problem.operator(undisplaced).unconstrained(rest - undisplaced), 0)
    mass = jnp.where(free, problem.mass[:, None], 1)
    setting = _Setting(
        problem=problem,
        rtol=rtol,
        mass=mass,
        scale=_norm(linearised, mass),
        inertia=_norm(combine(problem.mass[:, None] * problem.inertial, 0), mass),
        undisplaced=undisplaced,
        startable=jnp.isfinite(energies[0]) | jnp.isfinite(energies[1]),
    )
    first = jnp.where(setting.startable, setting.residual(start), linearised)
    zero_count, no = jnp.asarray(0, dtype=jnp.int32), jnp.asarray(False)
    return setting, _NewtonState(
        v=start,
        r=first,
        rounding=jnp.zeros((), guess.dtype),
        settled=no,
        iterations=zero_count,
        newton=zero_count,
        halvings=zero_count,
        stuck=no,
        indefinite=no,
    )


def _norm(r: NodeVector, mass: NodeVector) -> Float[Array, ""]:
    return jnp.sqrt((r**2 / mass).sum())


def _converged(setting: _Setting, c: _NewtonState) -> Bool[Array, ""]:
    left = setting.norm(c.r)
    speed = jnp.sqrt((setting.mass * setting.problem.projection.combine(c.v, 0) ** 2).sum())
    bounded = ~c.indefinite & (left <= NEGLIGIBLE_CHANGE * speed)
    return (left <= setting.rtol * setting.scale) | ((left <= c.rounding) & (c.settled | bounded))


def _step(solver: lx.AbstractLinearSolver, setting: _Setting, c: _NewtonState) -> _NewtonState:
    """One Newton step: direction, line search, residual."""
    problem = setting.problem
    unstarted = (c.newton == 0) & ~setting.startable
    operator = problem.newton_operator(jnp.where(unstarted, setting.undisplaced, c.v)).precomputed()
    inner = problem.preconditioner.inner_product(operator)
    direction = _direction(solver, operator, inner, c.r)
    energy = problem.incremental_potential(c.v)
    energy = jnp.where(jnp.isfinite(energy), energy, jnp.inf)
    weight = jnp.where(problem.projection.free, operator.diagonal(), 0)
    unit, eps = problem.unit_strain_velocity(), jnp.finfo(c.v.dtype).eps
    slack = _ROUNDING * eps * ((weight * unit**2).sum() + jnp.abs(energy))
    size, halvings = backtrack(
        lambda size: problem.incremental_potential(c.v + size * direction.value), energy, direction.slope, slack
    )
    v = c.v + size * direction.value
    return _NewtonState(
        v=v,
        r=setting.residual(v),
        rounding=_ROUNDING * eps * (setting.norm(weight * (jnp.abs(v) + unit)) + setting.inertia),
        settled=direction.whole & (halvings == 0) & _negligible(problem, inner, c.v, direction.value),
        iterations=c.iterations + direction.iterations,
        newton=c.newton + 1,
        halvings=c.halvings + halvings,
        stuck=halvings >= MOST_HALVINGS,
        indefinite=c.indefinite | direction.indefinite,
    )


def _direction(
    solver: lx.AbstractLinearSolver, operator: ImplicitOperator, inner: AbstractInnerProduct, r: NodeVector
) -> _Direction:
    """Newton's direction, or the steepest one where the potential does not fall along Newton's."""
    solution = solve_linear(solver, operator, -r, inner)
    slope = (r * solution.value).sum()
    steepest = inner.solve(-r) / jnp.maximum(solution.spectral_radius, 1)
    uphill = ~(slope < 0)
    return _Direction(
        value=jnp.where(uphill, steepest, solution.value),
        slope=jnp.where(uphill, (r * steepest).sum(), slope),
        whole=~uphill & solution.converged,
        iterations=solution.iterations,
        indefinite=solution.indefinite,
    )


def backtrack(
    merit: Callable[[Float[Array, ""]], Float[Array, ""]],
    start: Float[Array, ""],
    slope: Float[Array, ""],
    slack: Float[Array, ""],
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """The first step size a of 1, ½, ¼, ... with sufficient decrease, E(a) ≤ E(0) + 10⁻⁴ a E'(0) + slack (L. Armijo,
    Pacific J. Math. 16 (1966) 1, doi 10.2140/pjm.1966.16.1).

    The slack is the rounding of E. Near a minimum the expected decrease is smaller than it, and without slack a good
    step would be refused. NaN is no decrease, so a step that leaves the domain of E is halved.

    Args:
        merit: the function E of the step size [J].
        start: E(0).
        slope: E'(0), negative.
        slack: by how much E may miss the decrease [J].

    Returns:
        The step size, and the number of halvings. At `MOST_HALVINGS` the search has failed.
    """

    def refused(trial: tuple[Array, Array]) -> Bool[Array, ""]:
        size, halvings = trial
        decreased = merit(size) <= start + _SUFFICIENT_DECREASE * size * slope + slack
        return ~decreased & (halvings < MOST_HALVINGS)

    whole, zero_count = jnp.ones((), start.dtype), jnp.asarray(0, dtype=jnp.int32)
    return jax.lax.while_loop(refused, lambda trial: (trial[0] / 2, trial[1] + 1), (whole, zero_count))


def _negligible(problem: StageProblem, inner: AbstractInnerProduct, v: NodeVector, step: NodeVector) -> Bool[Array, ""]:
    """Whether a step changes the velocity by no more than a thousandth, or strains by no more than √ε."""
    unseen = jnp.sqrt(jnp.finfo(v.dtype).eps) * problem.unit_strain_velocity()
    vectors = step, problem.projection.combine(v + step, 0), jnp.where(problem.projection.free, unseen, 0)
    moved, speed, least = (jnp.sqrt((inner.apply(a) * a).sum()) for a in vectors)
    return moved <= jnp.maximum(NEGLIGIBLE_CHANGE * speed, least)


def _outcome(setting: _Setting, c: _NewtonState) -> tuple[NodeVector, SolveInfo]:
    left = setting.norm(c.r)
    size = jnp.maximum(jnp.maximum(setting.scale, setting.inertia), c.rounding)
    done = jnp.isfinite(left) & _converged(setting, c)
    info = SolveInfo(
        iterations=c.iterations,
        newton=c.newton,
        line_search=c.halvings,
        residual=left / jnp.where(size == 0, 1, size),
        converged=done,
        nearly_converged=~done & (left <= NEARLY_CONVERGED * setting.rtol * setting.scale),
        indefinite=c.indefinite,
        report=jnp.zeros_like(left),
    )
    return jnp.where(setting.problem.projection.free & ~jnp.isfinite(left), jnp.nan, c.v), info
