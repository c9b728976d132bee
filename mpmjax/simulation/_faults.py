"""The errors and warnings of a run."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.autodiff import guard
from mpmjax.checks import requirements, warn
from mpmjax.material import AbstractLaw
from mpmjax.simulation._diffrax import LEAST_STRETCH, Problem, RolloutState, faulty_particles, passed_particles, run_to
from mpmjax.simulation._run import Fault, Run, SimulationError
from mpmjax.state import Particles, Scene, state_of, warn_of_crowding
from mpmjax.stepping import SAFETY, AbstractIntegrator, UnknownBoundError, longest_step


def raise_faults(run: Run, problem: Problem, before: Callable[[], RolloutState], start: int) -> None:
    """Raise the faults of an untraced run that began at step `start`; `before` gives the last step's first state."""
    fault = Fault(int(run.statistics.fault))
    if fault != Fault.NONE:
        previous = before()
        step = start + int(run.statistics.fault_step)
        ends = replace(problem, particles=run.final, start=jnp.asarray(0, run.final.x.dtype))
        ends, before_step = ends.controlled(previous, jnp.asarray(step - 1, run.final.x.dtype))
        bad = faulty_particles(ends, state_of(run.final), step * run.dt)
        _, what, advice = _WORDS[fault]
        if fault == Fault.PASSED:
            t = jnp.asarray(step - 1, run.final.x.dtype) * run.dt
            passed = passed_particles(ends, before_step.particles, state_of(run.final), t)
            number, bad[fault] = next((i, mask) for i, mask in passed if mask.any())
            what = f"{what} boundary {number}, {type(run.scene.boundary[number]).__name__}"
            if run.scene.total:
                advice = "In the total description it holds only what touched it from the start: use the updated one."
        first = int(np.argmax(np.asarray(bad[fault])))
        if fault == Fault.INADMISSIBLE:
            law = run.scene.laws[int(np.searchsorted(np.cumsum(run.final.sizes), first, side="right"))]
            what, advice = disallowed(law, run.method)
        reached = int((run.steps < step).sum())
        saved: Any = RolloutState(cast(Any, run.frames), run.collider_impulse, run.boundary_impulse, run.memory)
        more = {"steps": run.steps, "observed": run.observed}
        frames, more = jax.tree.map(lambda a: a[:reached], (saved, more))
        good = run_to(problem, previous, step - 1, run.statistics, frames, **more)
        raise SimulationError(
            f"At step {step} (t = {step * float(run.dt):.6g} s) particle {first} {what}; the last good position was "
            f"{np.asarray(previous.particles.x[first])}. "
            + advise(run.scene, run.method, run.dt, problem.particles, good.final, advice)
            + averaging_advice(run.scene),
            good,
        )
    if int(run.statistics.unconverged) > 0:
        advice = [*run.method.unconverged_advice(), "reduce dt", "raise the solver's max_steps or loosen its rtol"]
        if run.final.x.dtype == jnp.float32:
            advice.append("take float64 particles, of which rounding leaves more digits")
        if not run.method.keeps_admissible:
            advice.append("BackwardEuler holds where one linear solve does not")
        text = "; ".join(advice)
        raise SimulationError(
            f"The solve of {int(run.statistics.unconverged)} of {int(run.statistics.steps)} steps did not converge "
            f"(worst relative residual {float(run.statistics.worst_residual):.2g}). "
            f"{text[0].upper()}{text[1:]}." + averaging_advice(run.scene),
            run,
        )


def warn_of_inaccuracy(run: Run) -> None:
    """A Python warning where solves of an untraced run missed their tolerance by less than ten times, one where
    the linearisation error of implicit steps is large, and one where particles take more space than there is."""
    scene, statistics = run.scene, run.statistics
    if not scene.total:
        warn_of_crowding(scene, run.final)
    if int(statistics.nearly_converged) > 0:
        warn(
            f"The solve of {int(statistics.nearly_converged)} of {int(statistics.steps)} steps missed its tolerance by "
            f"less than ten times (worst relative residual {float(statistics.worst_residual):.2g}): the run is that "
            "much less accurate than was asked for. Raise the solver's max_steps, or ask for what it can reach by its "
            "rtol."
        )
    error = float(statistics.linearisation_error)
    if error > LARGEST_LINEARISATION_ERROR and any(law.relaxes_stress for law in scene.laws):
        warn(
            f"Implicit steps have a linearisation error of up to {100 * error:.2g} % of the elastic force: in the "
            "solve, what yields or flows resists as if it were elastic, and its flow is returned only at the end of "
            f"the step, so that it flows too slowly. Take a step {error / LARGEST_LINEARISATION_ERROR:.1f} times "
            "shorter or more, or Explicit()."
        )
    elif error > LARGEST_LINEARISATION_ERROR:
        warn(
            f"One linear solve a step has a linearisation error of up to {100 * error:.2g} % of the elastic force, and "
            "stresses can be wrong by as much. Take a shorter step, "
            f"{float(np.sqrt(error / LARGEST_LINEARISATION_ERROR)):.1f} times or more, or Newton's method: "
            "BackwardEuler(), or solution=Newton() of ImplicitMidpoint and TRBDF2."
        )


_WORDS: dict[Fault, tuple[str, str, str]] = {
    Fault.NOT_FINITE: (
        "a state that is not finite",
        "is no longer finite",
        "Look in the frames before (save_every) for what grows out of scale: a force, a prescribed motion, a velocity.",
    ),
    Fault.OUTSIDE: (
        "a particle outside the grid's window",
        "left the grid's window",
        "Enlarge the grid's shape, or use follow=True.",
    ),
    Fault.INADMISSIBLE: ("a deformation gradient that its law does not allow", "", ""),
    Fault.COLLAPSED: (
        "a particle that has collapsed",
        f"has collapsed: a stretch of it is below {LEAST_STRETCH:g}, where the force of its law may vanish",
        "Take a law whose energy has no bound there, such as NeoHookean, or in the total description any; or a lower "
        "velocity.",
    ),
    Fault.PASSED: (
        "a particle that passed a boundary",
        "passed",
        "Reduce dt: a boundary keeps out what comes less than a cell nearer in a step.",
    ),
}
"""The parts of a fault's message: subject, where no particle can be named; predicate of a particle, after its number,
and remedy, both empty where they depend on the law (`disallowed`)."""
LARGEST_LINEARISATION_ERROR = 0.05  # linearisation error [-] of a run beyond which it is warned of
_ADVICE = (
    "Call simulate outside of jax transformations to have step, time and particle named, or with throw=False to "
    "inspect run.statistics."
)
UNSOLVED = (
    "mpmjax: {} solve of a step did not converge, so that there is no derivative. Raise the "
    "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner()."
)


def guarded(run: Run, report: Array) -> Run:
    """The run, guarded: neither its numbers nor their derivatives can be used if it met a fault."""
    inputs, rest = eqx.partition((run.scene, run.final, run.method), eqx.is_array)
    names: list[str] = []
    jax.eval_shape(lambda a: names.extend(r.message for r in requirements(eqx.combine(a, rest))), inputs)
    statistics = run.statistics
    states = [(state, statistics.fault == fault) for fault, (state, *_) in _WORDS.items()]
    states.append(("a solve that did not converge", statistics.unconverged > 0))  # after what is graver
    met = jnp.stack([holds for _, holds in states])
    number = jnp.where(met.any(), 1 + jnp.argmax(met).astype(jnp.int32), 0)
    number = jnp.where(statistics.unmet > 0, len(states) + statistics.unmet, number)
    messages = [*(f"{what}. {_ADVICE}" for what, _ in states), *names]
    faults = [f"mpmjax: the rollout met a fault: {what}" for what in messages]
    return guard(run, report, number, faults, UNSOLVED.format("the tangent"))[0]


def advise(scene: Scene, method: AbstractIntegrator, dt: Any, began: Particles, last: Particles, otherwise: str) -> str:
    """Advice on a fault: to shorten the step if it was too long, else what the fault itself suggests.

    A step above the limit explains any fault, but not every run with such a step fails by it. So both are said then.
    The particles are those at the start and the last good ones.
    """
    try:
        first, then = (float(longest_step(scene, particles, method)) for particles in (began, last))
    except UnknownBoundError:
        return otherwise
    if scene.kernel.order == 1 and not scene.total:
        then = first  # it changes with every move of the particles, and is zero at each cell's face
    if math.isnan(then):
        then = first  # too deformed to tell
    comparable = math.isfinite(first) and first > 0 and then > 0
    if not comparable or float(dt) <= SAFETY * min(first, then):
        return otherwise
    times = float(dt) / first
    text = f"dt = {float(dt):.4g} s is {times:.3g} times the {method.limit_name()} at the start ({first:.4g} s)"
    if not math.isclose(first, then, rel_tol=1e-2):
        text += f" and {float(dt) / then:.3g} times that of the last good state ({then:.4g} s)"
    if float(dt) <= min(first, then):
        text += f"; from {SAFETY:g} times on, large vibrations can grow"
    shortly = otherwise[0].lower() + otherwise[1:]
    shorter = f"at most {SAFETY * first:.4g} s (stable_dt, safety {SAFETY:g})" if float(dt) > SAFETY * first else "less"
    return f"{text}. Take a dt of {shorter}, or an implicit method that has no limit. If the fault stays, {shortly}"


def averaging_advice(scene: Scene) -> str:
    """A sentence on averaged volumes where a law that hardly changes its volume has own ones; else empty."""
    laws = scene.laws if scene.volume is None else ()
    if not any(law.allows_averaged_volume and law.hardly_changes_volume() for law in laws):
        return ""
    return (
        " With own volumes nearly incompressible material locks, and its pressures differ from particle to particle: "
        "give the scene volume=AveragedVolume()."
    )


def disallowed(law: AbstractLaw, method: AbstractIntegrator) -> tuple[str, str]:
    """Two parts of a message: the deformation that the law does not allow, and the remedy."""
    newton = ", or take BackwardEuler(), whose line search forbids it"
    return law.inadmissible("" if method.is_explicit or method.keeps_admissible else newton)
