"""The reference motion of `work_precision`: a run refined until it changes little or its time is up.

If explicit steps are cheap it uses them, at the `stable_dt` of the whole motion, which resolves all that the grid does.
Otherwise it uses TR-BDF2, and halves the step until that changes the motion by less than a third of the target error,
or until the step is below the explicit limit. Then spacing and step are halved together: transfers act once a step, so
on a given grid a smaller step alone need not improve the motion. The last change estimates the error of the reference
run; the estimate is safe for convergence of first order or more.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from mpmjax.analysis._bench import FRAMES, Bench, Build, Clock, Displacements, Trial, name_of
from mpmjax.checks import require
from mpmjax.state import State
from mpmjax.stepping import TRBDF2, AbstractIntegrator, Explicit

HOPELESS = 4
"""A run that fails at a step this many times below the explicit limit is taken to fail at any step."""
_FEW = 1000  # explicit steps that no implicit run which follows the motion is cheaper than

Say = Callable[[str], None]


class Reference(NamedTuple):
    """The reference run."""

    limit: float
    """The longest explicit step on the scene's own grid that trials may take, `stable_dt` of the whole motion [s]."""
    trial: Trial
    """The run; its error is an estimate."""
    motion: Displacements


class _RefinedRun(NamedTuple):
    """A run, and its relative change of the motion of the run before."""

    bench: Bench
    steps: int
    seconds: float
    states: list[State] | None
    motion: Displacements | None
    """None if the run failed."""
    change: float

    @property
    def dt(self) -> float:
        """Δt [s]."""
        return self.bench.t1 / self.steps


def settle(build: Build, bench: Bench, error: float, seconds: float, say: Say = lambda line: None) -> Reference:
    """The best reference run within an allowance of time.

    Args:
        build: makes the scene at a refinement.
        bench: the bench of the scene's own grid.
        error: the target error of the trials.
        seconds: the allowance, compilation included [s].
        say: called with a line on each run.

    Raises:
        ValueError: nothing moves, or no run ended well in that time; the message says what went wrong.
    """
    clock, growth = Clock(seconds), 2 ** (bench.particles.dim + 1)
    limit = bench.limit([])
    steps, method = bench.whole(limit), Explicit()
    say(f"reference: {bench.particles.count} particles, {steps} explicit steps of {bench.t1 / steps:.3g} s; compiling")
    foreseen = bench.foresee(method, steps)
    if (1 + growth) * foreseen > clock.left and steps > _FEW:
        steps, method = 2 * FRAMES, TRBDF2()
    elif not clock.allows(2 * foreseen):
        raise ValueError(f"{steps} explicit steps take {foreseen:.2g} s and two runs are needed: {_more(seconds)}")
    limit, good = _resolved_in_time(bench, method, steps, limit, error, clock, say)
    while growth * good.seconds < clock.left and (good.bench is bench or good.change > error / 3):
        finer = _refined_run(Bench.of(build, 2 * good.bench.refinement, bench.t1), method, 2 * good.steps, good, say)
        if finer.motion is None:
            break
        good = finer
    alone = good.bench is bench  # there was no time for a finer grid
    while alone and good.change > error / 3 and (math.isinf(good.change) or clock.allows(2 * good.seconds)):
        again = _refined_run(bench, method, 2 * good.steps, good, say)
        if again.motion is None:
            break
        good = again
    assert good.motion is not None
    require(math.isfinite(good.change), f"The motion of one run only is known: {_more(seconds)}")
    return Reference(
        limit, Trial(method, good.bench.refinement, good.dt, good.steps, good.seconds, good.change), good.motion
    )


def _resolved_in_time(
    bench: Bench, method: AbstractIntegrator, steps: int, limit: float, error: float, clock: Clock, say: Say
) -> tuple[float, _RefinedRun]:
    """The explicit limit over the motion on the scene's own grid [s], and the run whose step resolves the motion, or
    the last one within the time."""
    good = None
    while True:
        new = _refined_run(bench, method, steps, good, say)
        if new.states is not None and new.motion is not None:
            require(new.motion.size > 0, "Nothing moves in this scene, so there is no motion to be right or wrong.")
            limit, good = min(limit, bench.limit(new.states)), new
        hopeless = good is None and new.dt < limit / HOPELESS
        enough = good is not None and (new.change <= error / 3 or new.dt <= limit * (1 + 1e-9))
        if good is not None and (enough or not clock.allows(2 * new.seconds)):
            return limit, good
        if hopeless or not clock.allows(2 * new.seconds):
            raise ValueError(
                f"The reference run, {name_of(method)} in {steps} steps ({new.seconds:.2g} s), fails, and half "
                f"the step will not do or takes too long. {bench.why(method, steps)}"
            )
        steps = max(2 * steps, bench.whole(limit) if method.is_explicit else 0)


def _refined_run(
    bench: Bench, method: AbstractIntegrator, steps: int, before: _RefinedRun | None, say: Say
) -> _RefinedRun:
    states, _, seconds = bench.run(method, steps)
    motion = None if states is None else bench.motion(states)
    coarse = None if before is None else before.motion
    change = math.inf if motion is None or coarse is None else coarse.distance(motion)
    spacing = f", spacing / {bench.refinement}" if bench.refinement > 1 else ""
    outcome = "failed" if motion is None else "" if math.isinf(change) else f"changes the motion by {change:.2g}"
    say(f"reference: {name_of(method)}, {steps} steps{spacing}: {seconds:.2g} s {outcome}".rstrip())
    return _RefinedRun(bench, steps, seconds, states, motion, change)


def _more(seconds: float) -> str:
    return (
        f"more than the {seconds:.3g} s that a reference is given. Allow more (most_seconds in [run], --most-seconds), "
        "choose a shorter t1, or give dt and method."
    )
