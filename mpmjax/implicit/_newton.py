"""Newton's method for the nodal problems."""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector, Scalar
from mpmjax.checks import require_fields, tolerance, whole
from mpmjax.implicit._solve_info import SolveInfo, require_solver
from mpmjax.implicit._solver import DEFAULT_RTOL, NEARLY_CONVERGED, NEGLIGIBLE_CHANGE, ConjugateResidual, solve_linear
from mpmjax.implicit._stage import AbstractStageSolver, StageProblem

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
