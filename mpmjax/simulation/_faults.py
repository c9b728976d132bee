"""The errors and warnings of a run."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.autodiff import guard
from mpmjax.checks import requirements, warn
from mpmjax.material import AbstractLaw
from mpmjax.simulation._advice import advise, disallowed
from mpmjax.simulation._diffrax import Problem, faulty_particles, passed_particles
from mpmjax.simulation._rollout_state import RolloutState
from mpmjax.simulation._run import Run, SimulationError
from mpmjax.simulation._statistics import (
    BAD_PARAMETERS,
    BEYOND,
    HEALTHY,
    INADMISSIBLE,
    NOT_FINITE,
    OUTSIDE,
    RunStatistics,
)
from mpmjax.state import Particles, state_of, with_state
from mpmjax.stepping import AbstractIntegrator


def raise_faults(run: Run, began: Particles, previous: RolloutState | None, start: int) -> None:
    """Raise the faults in the statistics of an untraced run.

    Args:
        run: the run, its final state possibly bad.
        began: the particles at the start.
        previous: the state before the last step.
        start: number of the run's first step.
    """
    fault = int(run.statistics.fault)
    if fault != HEALTHY:
        assert previous is not None
        step = start + int(run.statistics.fault_step)
        problem = Problem(run.scene, run.final, None, run.dt, run.method)
        broken, outside, inadmissible = faulty_particles(problem, state_of(run.final))
        bad: dict[int, Array] = {NOT_FINITE: broken, OUTSIDE: outside, INADMISSIBLE: inadmissible}
        what, advice = _FAULTS.get(fault, ("", ""))
        if fault == BEYOND:
            t = jnp.asarray(step - 1, run.final.x.dtype) * run.dt
            passed = passed_particles(problem, previous.particles, state_of(run.final), t)
            number, bad[BEYOND] = next((i, mask) for i, mask in passed if mask.any())
            what = f"{what} boundary {number}, {type(run.scene.boundary[number]).__name__}"
            if run.scene.total:
                advice = "In the total description it holds only what touched it from the start: use the updated one."
        first = int(np.argmax(np.asarray(bad[fault])))
        if fault == INADMISSIBLE:
            what, advice = disallowed(_law(run, first), run.method)
        last = with_state(run.final, previous.particles)
        reached = int((run.steps < step).sum())
        good = eqx.tree_at(
            lambda r: (
                *(r.final, r.final_collider_impulse, r.final_step),
                *(r.steps, r.frames, r.observed, r.collider_impulse),
            ),
            run,
            (
                *(last, previous.collider_impulse, jnp.asarray(step - 1, run.final_step.dtype)),
                *jax.tree.map(lambda a: a[:reached], (run.steps, run.frames, run.observed, run.collider_impulse)),
            ),
            is_leaf=lambda leaf: leaf is None,
        )
        raise SimulationError(
            f"At step {step} (t = {step * float(run.dt):.6g} s) particle {first} {what}; the last good position was "
            f"{np.asarray(previous.particles.x[first])}. {advise(run.scene, run.method, run.dt, began, last, advice)}",
            good,
        )
    if int(run.statistics.unconverged) > 0:
        raise SimulationError(
            f"The solve of {int(run.statistics.unconverged)} of {int(run.statistics.steps)} steps did not converge "
            f"(worst relative residual {float(run.statistics.worst_residual):.2g}). "
            + unconverged_advice(run.method, run.final.x.dtype),
            run,
        )


def unconverged_advice(method: AbstractIntegrator, dtype: Any) -> str:
    """Advice on a solve that does not converge."""
    advice = [*method.unconverged_advice(), "reduce dt", "raise the solver's max_steps or loosen its rtol"]
    if jnp.dtype(dtype) == jnp.float32:
        advice.append("take float64 particles, of which rounding leaves more digits")
    if not method.keeps_admissible:
        advice.append("BackwardEuler holds where one linear solve does not")
    text = "; ".join(advice)
    return f"{text[0].upper()}{text[1:]}."


def warn_of_inaccurate_solves(statistics: RunStatistics) -> None:
    """A Python warning where solves of an untraced run missed their tolerance by less than ten times."""
    if int(statistics.nearly_converged) > 0:
        warn(
            f"The solve of {int(statistics.nearly_converged)} of {int(statistics.steps)} steps missed its tolerance by "
            f"less than ten times (worst relative residual {float(statistics.worst_residual):.2g}): the run is that "
            "much less accurate than was asked for. Raise the solver's max_steps, or ask for what it can reach by its "
            "rtol."
        )


def _law(run: Run, particle: int) -> AbstractLaw:
    """The law of a particle, by its number."""
    last = np.cumsum(run.final.sizes)
    return run.scene.laws[int(np.searchsorted(last, particle, side="right"))]


_FAULTS: dict[int, tuple[str, str]] = {
    NOT_FINITE: (
        "is no longer finite",
        "Look in the frames before (save_every) for what grows out of scale: a force, a prescribed motion, a velocity.",
    ),
    OUTSIDE: ("left the grid's window", "Enlarge the grid's shape, or use follow=True."),
    BEYOND: (
        "passed",
        "Reduce dt: a boundary keeps out what comes less than a cell nearer in a step.",
    ),
}


_STATE_FAULTS = (
    "a state that is not finite",
    "a particle outside the grid's window",
    "a deformation gradient that its law does not allow",
    "a particle that passed a boundary",
)
"""The texts of NOT_FINITE and the following codes if no particle can be named."""
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
    met = [f"the rollout met a fault: {what}. {_ADVICE}" for what in (*_STATE_FAULTS, "a solve that did not converge")]
    bad = [f"the rollout met a fault: {name}" for name in names]
    statistics, unsolved = run.statistics, len(met)
    state = jnp.where((statistics.fault == HEALTHY) & (statistics.unconverged > 0), unsolved, statistics.fault)
    number = jnp.where(statistics.fault >= BAD_PARAMETERS, unsolved + 1 + statistics.fault - BAD_PARAMETERS, state)
    faults = [f"mpmjax: {message}" for message in (*met, *bad)]
    return guard(run, report, number, faults, UNSOLVED.format("the tangent"))[0]
