"""What accuracy costs: a scene's error against seconds, by method, step and spacing, and the cheapest setting that is
good enough.

The error is that of the motion: the largest over eight evenly spaced times of the RMS over particles of the distance
between a particle's displacement and the reference run's, over the largest RMS displacement of the latter. Where the
reference has k particles for one, the mean of the k nearest at time zero stands for it.
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

from mpmjax.analysis._bench import FRAMES, Bench, Build, Clock, Trial, name_of
from mpmjax.analysis._reference_run import HOPELESS, settle
from mpmjax.checks import checked, require_positive
from mpmjax.stepping import TRBDF2, AbstractIntegrator, BackwardEuler, Explicit, ImplicitMidpoint, SemiImplicit

METHODS: tuple[AbstractIntegrator, ...] = (Explicit(), SemiImplicit(), ImplicitMidpoint(), TRBDF2(), BackwardEuler())
"""The methods that are tried by default."""
_RESOLVED = 0.25  # the error above which a larger one at a smaller step does not say that the best was reached
_REFERENCE_SHARE = 0.4  # of all seconds
_AS_GOOD = 1.1  # how much larger an error still counts as the same


class WorkPrecision(NamedTuple):
    """Errors against seconds, and the cheapest setting."""

    trials: tuple[Trial, ...]
    reference: Trial
    """The reference run; its error is an estimate."""
    target: float
    """The error that was asked for."""
    limit: float
    """The longest explicit step on the scene's own grid that is offered, `stable_dt` of the whole motion [s]."""
    skipped: tuple[str, ...] = ()
    """Methods for which there was no time."""

    def cheapest(self, *, explicit: bool | None = None) -> Trial | None:
        """The fastest trial that is good enough: of all, of the explicit ones or of the others; None if none is.

        Good enough is the target or, where no trial reaches it, a quarter above the least error of all, which then is
        that of the grid. A trial is as good as the worst of itself, the next smaller step (where the error passes
        through zero on its way from one sign to the other, that is luck) and the reference, whose own error it cannot
        be told from. An explicit step beyond the limit is not good, however well it went.
        """
        trials = [t for t in self.trials if not (t.method.is_explicit and t.dt * t.refinement > self.limit)]
        errors = [max(t.error, self._next(t).error, self.reference.error) for t in trials]
        enough = max(self.target, 1.25 * min((e for e in errors if e >= 0), default=math.inf))
        good = [t for t, e in zip(trials, errors, strict=True) if e <= enough < math.inf]
        good = [t for t in good if explicit in (None, t.method.is_explicit)]
        return min(good, key=lambda trial: trial.seconds, default=None)

    def _next(self, trial: Trial) -> Trial:
        """The trial with the next smaller step, or the trial itself."""
        own = [t for t in self.trials if (t.refinement, name_of(t.method)) == (trial.refinement, name_of(trial.method))]
        finer = [t for t in own if t.dt < trial.dt and not math.isnan(t.error)]
        return max(finer, key=lambda t: t.dt, default=trial)

    def verdict(self) -> str:
        """The cheapest setting in words, and what the other kind of method would have cost."""
        best = self.cheapest()
        if best is None:
            return "No run ended well: allow more seconds or choose a shorter t1."
        is_explicit = best.method.is_explicit
        rival = self.cheapest(explicit=not is_explicit)
        foreseen = [t for t in self.trials if math.isnan(t.error) and t.method.is_explicit != is_explicit]
        if rival is not None:
            other = f"{rival} needs {rival.seconds:.2g} s"
        elif foreseen:
            cheap = min(foreseen, key=lambda trial: trial.seconds)
            other = f"{cheap} would need {cheap.seconds:.2g} s"
        else:
            other = f"no {'implicit' if is_explicit else 'explicit'} setting tried is as good"
        said = f"{best} ({best.steps} steps): {best.seconds:.2g} s, error {best.error:.2g}; {other}."
        if best.error > self.target:
            said += f" None reached {self.target:g}: on the grids tried no step does better."
        if self.reference.error > self.target / 2:
            said += f" The reference is known to {self.reference.error:.2g} only, and so are the errors."
        if self.reference.refinement == 1:
            said += " There was no time for a finer grid: the errors are those of the step alone."
        if self.skipped:
            said += f" There was no time for {', '.join(self.skipped)}."
        return said


@checked
def work_precision(
    build: Build,
    *,
    t1: float,
    error: float = 1e-2,
    methods: tuple[AbstractIntegrator, ...] = METHODS,
    refinements: tuple[int, ...] = (1, 2),
    also: tuple[tuple[AbstractIntegrator, float], ...] = (),
    most_seconds: float = 60.0,
    progress: Callable[[Trial], None] = lambda trial: None,
    say: Callable[[str], None] = lambda line: None,
) -> WorkPrecision:
    """Run a scene by several methods, on several grids, with ever smaller steps, until each is as good as asked for,
    gets no better, or costs more than another that is.

    Implicit methods start with eight steps in all; explicit ones at the default safety of `stable_dt`, at the greatest
    stretch of the reference run on the scene's own grid, and once at twice that, which should fail. A method that
    another one betters on the scene's own grid, with no larger error in no more seconds whatever its step, is not tried
    on finer ones, and no grid is tried that is finer than the reference run's.

    The seconds are this machine's, so the result is not a function of the arguments alone. They are shared out: two
    fifths for the reference run, of what is left as much for one method as for another. What would take longer is
    foreseen from fewer steps, and what cannot be tried at all is named.

    *When it breaks*: where refinement does not settle the motion (chaotic contact, PIC at long times), the reference
    is uncertain, and says so in its `error`.

    Args:
        build: from a refinement n = 1, 2, 4, ... to the scene with 1/n of its spacing and as many particles a cell.
        t1: end time [s].
        error: the relative error that is asked for.
        methods: what is tried.
        refinements: on which grids.
        also: methods with one step [s] each, tried besides on the scene's own grid.
        most_seconds: what all of it may take, compilation included [s]. A run that has begun is ended.
        progress: called with each trial as it is done.
        say: called with a line on each reference run.

    Raises:
        ValueError: from `prepare`; nothing moves, or no reference run ended well.
    """
    require_positive("t1 [s]", t1)
    require_positive("error", error)
    require_positive("most_seconds", most_seconds)
    clock, own = Clock(most_seconds), Bench.of(build, 1, t1)
    limit, reference, truth = settle(build, own, error, _REFERENCE_SHARE * most_seconds, say)
    trials: list[Trial] = []
    skipped: list[str] = []

    def note(bench: Bench, method: AbstractIntegrator, steps: int, seconds: float, miss: float) -> Trial:
        trials.append(Trial(method, bench.refinement, bench.t1 / steps, steps, seconds, miss))
        progress(trials[-1])
        return trials[-1]

    def tried(bench: Bench, method: AbstractIntegrator, steps: int) -> Trial:
        states, seconds = bench.run(method, steps)
        miss = math.inf if states is None else bench.motion(states).distance(truth)
        return note(bench, method, steps, seconds, miss)

    def rival(method: AbstractIntegrator) -> float:
        """Seconds of the cheapest run so far that is as good as asked for, explicit or implicit as the method is."""
        best = WorkPrecision(tuple(trials), reference, float(error), limit).cheapest(explicit=method.is_explicit)
        return math.inf if best is None or best.error > error else best.seconds

    def refine(bench: Bench, method: AbstractIntegrator, part: float) -> None:
        steps, best, idle = FRAMES, math.inf, 0
        if method.is_explicit:
            steps = bench.whole(limit / bench.refinement)
        foreseen = bench.foresee(method, steps)
        share = Clock(part * clock.left)  # once it is compiled
        if not share.allows(foreseen):
            note(bench, method, steps, foreseen, math.nan)
            return
        if method.is_explicit:
            tried(bench, method, bench.whole(2 * limit / bench.refinement))
        while best > max(error / 3, reference.error / 2) and idle < 2:
            trial = tried(bench, method, steps)
            resolved = trial.error < _RESOLVED or trial.dt < limit / bench.refinement
            idle = idle + 1 if resolved and trial.error > 0.8 * best else 0
            best = min(best, trial.error)
            if trial.error == math.inf and trial.dt < limit / (HOPELESS * bench.refinement):
                return
            if (trial.seconds if trial.error <= error else 2 * trial.seconds) > rival(method):
                return
            steps *= 2
            if not share.allows(2 * trial.seconds):
                note(bench, method, steps, 2 * trial.seconds, math.nan)
                return

    def bettered(method: AbstractIntegrator) -> bool:
        """Whether others do as well as this implicit method on the scene's own grid for no more seconds."""
        first = [t for t in trials if t.refinement == 1 and t.method.is_explicit == method.is_explicit]
        own = [t for t in first if t.method is method and math.isfinite(t.error)]
        others = [t for t in first if t.method is not method]
        return all(any(o.error <= _AS_GOOD * t.error and o.seconds <= t.seconds for o in others) for t in own)

    benches = {1: own}
    plan = [(n, method) for n, method in itertools.product(refinements, methods) if n <= reference.refinement or n == 1]
    for k, (n, method) in enumerate(plan):
        if n > 1 and 1 in refinements and not method.is_explicit and bettered(method):
            continue
        if clock.left <= 0:
            skipped.append(name_of(method) + (f" at spacing / {n}" if n > 1 else ""))
            continue
        benches[n] = benches[n] if n in benches else Bench.of(build, n, t1)
        refine(benches[n], method, 1 / (len(plan) - k))
    for method, dt in also:
        tried(own, method, own.whole(dt))
    return WorkPrecision(tuple(trials), reference, float(error), limit, tuple(skipped))
