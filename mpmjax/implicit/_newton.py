"""Newton's method for the nodal problems."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, NodeVector, Scalar
from mpmjax.checks import require, require_fields, require_tolerance
from mpmjax.implicit._conjugate_residual import SETTLED, SHORT, ConjugateResidual, default_rtol
from mpmjax.implicit._problems import NewtonProblem, SolveInfo


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
        split, free = problem.projection.combine, problem.projection.free
        metric = jnp.where(free, problem.mass[:, None], 1)
        unit_strain = problem.unit_strain()
        dtype = guess.dtype
        eps = jnp.finfo(dtype).eps
        rtol = default_rtol(dtype) if self.rtol is None else self.rtol

        def norm(r: NodeVector) -> Float[Array, ""]:
            return jnp.sqrt((r**2 / metric).sum())

        def residual(v: NodeVector) -> NodeVector:
            return split(problem.momentum_residual(v), 0)

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
        start = problem.apply_dirichlet(guess)
        energies = problem.merit(start), problem.merit(lift)
        start = jnp.where(jnp.isfinite(energies[0]) & ~(energies[1] < energies[0]), start, lift)
        startable = jnp.isfinite(energies[0]) | jnp.isfinite(energies[1])
        zero = jnp.asarray(0, dtype=jnp.int32)
        still = problem.undisplaced()
        linearised = problem.momentum_residual(still) + problem.operator(still).unconstrained(lift - still)
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
