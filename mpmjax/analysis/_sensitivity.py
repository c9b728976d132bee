"""The growth of a rollout's derivatives over its horizon."""

import warnings
from typing import Annotated, Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, ParticleVector, Scalar
from mpmjax.checks import checked, is_traced, positive, require, require_whole
from mpmjax.simulation import Fault, RunStatistics, number_of_steps, simulate
from mpmjax.state import Particles, Scene, prepare
from mpmjax.stepping import AbstractIntegrator, Explicit, step_for

_POINTS = 100


class Sensitivity(eqx.Module):
    """The growth of a rollout's derivative with respect to the initial velocities, over its horizon."""

    times: Float[Array, "f"]  # time since the start [s], shape (f,)
    steps: Float[Array, "f"]  # steps since the start, shape (f,)
    growth: Float[Array, "f"]
    """‖δx‖ / (t ‖δv0‖) [-], shape (f,): the dependence of positions on initial velocities, relative to free flight. NaN
    after a fault of the run, and everywhere if a solve of the run or of its derivative did not converge."""
    rate: Float[Array, ""]
    """Exponential rate of the growth [1/s], a finite-time Lyapunov exponent: the slope of a line fitted to the
    logarithm of its finite values. Zero for free flight, negative if motion is damped or oscillates."""

    @property
    def worst(self) -> Float[Array, ""]:
        """The largest growth; NaN if a value is NaN."""
        return self.growth.max()


@checked
def sensitivity(
    scene: Scene,
    particles: Particles,
    *,
    t1: Scalar,
    dt: Scalar | Literal["stable"],
    method: AbstractIntegrator = Explicit(),
    direction: ParticleVector | None = None,
    seed: int = 0,
    save_every: int | None = None,
    start: Scalar = 0,
    warn_at: Annotated[float | int, positive] = 1e3,
) -> Sensitivity:
    """Tells whether gradients over this horizon are useful: the growth of a small change of the initial velocities.

    The change δv0 is propagated to a change δx of the positions by forward-mode differentiation of the steps:

        growth(t) = ‖δx(t)‖ / (t ‖δv0‖),  ‖a‖² = Σ_p m_p a_p².

    It is 1 in free flight, and less with oscillation and damping. The default change is normally distributed and
    independent for each particle, so its growth estimates the root mean square over all directions. Gradients of
    functions of the final positions grow likewise (∂x/∂v0 and its transpose have the same singular values), and
    derivatives by other quantities that act through the motion (stiffness, gravity, positions) at the same rate.

    *When it warns*: at a growth beyond `warn_at`, or a fault of the run. The motion then is chaotic (many contacts,
    crumpling) or the step unstable. An exact gradient holds only for changes of the order of 1/growth, and is of no use
    to an optimiser. Shorten the horizon, observe averages, or reduce dt if the step is unstable.

    The cost is two to three runs, the memory that of the saved positions.

    Args:
        scene, particles, dt, method, start: as in `simulate`.
        t1: end time [s], a multiple of the step.
        direction: the change δv0 of the initial velocities, of any size, shape (p, d). Default: normal, variance 1/m_p.
        seed: of the default change.
        save_every: measure every so many steps, and at the end. Default: about a hundred times.
        warn_at: growth [-] from which a Python warning is given (under `jax.jit` and the like none is).

    Raises:
        ValueError: as `simulate`; a change of the wrong shape, or zero.
    """
    start = require_whole("start", start, 0)
    particles = prepare(scene, particles)
    dt = step_for(scene, particles, t1, dt, method, start)
    count = number_of_steps(t1, dt, start, particles.x.dtype)
    every = max(1, count // _POINTS) if save_every is None else save_every
    shape, dtype = particles.v.shape, particles.v.dtype
    if direction is None:
        change = jax.random.normal(jax.random.key(seed), shape, dtype) / jnp.sqrt(particles.mass)[:, None]
    else:
        change = jnp.asarray(direction, dtype)
    require(change.shape == shape, f"direction must have the particles' shape {shape}, got {change.shape}.")
    require((change != 0).any(), "direction must not be zero everywhere: there is nothing to follow.")

    def flown(v: ParticleVector) -> tuple[tuple[Array, Any], tuple[Array, RunStatistics]]:
        thrown = eqx.tree_at(lambda p: p.v, particles, v)
        course: Any = {"t1": t1, "dt": dt, "method": method, "start": start, "save_every": every}
        run = simulate(scene, thrown, **course, observe=_positions, adjoint=diffrax.ForwardMode(), throw=False)
        return (run.observed, run.report), (run.steps, run.statistics)

    _, (moved, unsolved), (steps, statistics) = jax.jvp(flown, (particles.v,), (change,), has_aux=True)
    report = _measure(
        moved[1:], steps[1:] - steps[0], statistics, unsolved, particles.mass, change, jnp.asarray(dt, dtype)
    )
    if is_traced(report) or report.worst <= warn_at:
        return report
    if not statistics.healthy:
        fault, step = int(statistics.fault), int(statistics.fault_step)
        what = "does not solve its equations" if fault == Fault.NONE else f"meets a fault at step {step}"
        why = f"the run {what} and has no derivative from there on: see what simulate says of it."
    elif float(unsolved) > 0:
        why = (
            "the run has a derivative that is not known: the tangent solve of a step did not converge (relative "
            f"residual {float(unsolved):.2g}). Raise the max_steps of the method's adjoint_solver, or leave "
            "its preconditioner at DiagonalPreconditioner()."
        )
    else:
        first = int(jnp.argmax(~(report.growth <= warn_at)))
        why = (
            f"the derivative of the positions by the initial velocities grows to {float(report.worst):.2g} times that "
            f"of free flight, at a rate of {float(report.rate):.3g} /s; it passes {warn_at:.4g} by step "
            f"{int(report.steps[first])} (t = {float(report.times[first]):.4g} s). Gradients over this horizon say "
            "little: shorten it, or reduce dt if the step is unstable."
        )
    horizon = f"Over {int(report.steps[-1])} steps (t = {float(report.times[-1]):.4g} s) "
    warnings.warn(horizon + why, stacklevel=2)
    return report


def _positions(scene: Scene, particles: Particles) -> ParticleVector:
    return particles.x


@jax.jit
def _measure(
    moved: Array, steps: Array, statistics: RunStatistics, unsolved: Array, mass: Array, change: Array, dt: Array
) -> Sensitivity:
    def norm(a: Array) -> Array:
        return jnp.sqrt((mass[:, None] * a**2).sum(axis=(-2, -1)))

    times = steps * dt
    faulty = (statistics.fault != Fault.NONE) & (steps >= statistics.fault_step.astype(steps.dtype))
    lost = faulty | (statistics.unconverged > 0) | (unsolved > 0)
    growth = jnp.where(lost, jnp.nan, norm(moved) / (times * norm(change)))
    usable = jnp.isfinite(growth) & (growth > 0)
    weight = usable.astype(growth.dtype)
    weight = weight / jnp.maximum(weight.sum(), 1)
    logarithm = jnp.log(jnp.where(usable, growth, 1))
    centred = times - (weight * times).sum()
    scatter = (weight * centred**2).sum()
    rate = (weight * centred * logarithm).sum() / jnp.where(scatter == 0, 1, scatter)
    return Sensitivity(times=times, steps=steps, growth=growth, rate=rate)
