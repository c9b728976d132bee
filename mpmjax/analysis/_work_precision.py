"""The error of a scene against seconds, by method, step and spacing, and the cheapest setting that is good enough.

The error is that of the motion: the largest of eight evenly spaced times of the RMS over particles of the difference
from a reference run's displacement (where it has k particles for one, the mean of the k nearest at time zero), over the
reference run's largest RMS displacement.
"""

import itertools
import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

from mpmjax.analysis._bench import FRAMES, HOPELESS, Bench, Build, Clock, Trial, name_of, settle
from mpmjax.checks import checked, positive
from mpmjax.simulation import LARGEST_LINEARISATION_ERROR
from mpmjax.stepping import TRBDF2, AbstractIntegrator, BackwardEuler, Explicit, ImplicitMidpoint, SemiImplicit

METHODS: tuple[AbstractIntegrator, ...] = (Explicit(), SemiImplicit(), ImplicitMidpoint(), TRBDF2(), BackwardEuler())
"""The default methods."""
_RESOLVED = 0.25  # the error above which a larger one at a smaller step does not say that the best was reached
_REFERENCE_SHARE = 0.4  # of all seconds
_AS_GOOD = 1.1  # how much larger an error still counts as the same


class WorkPrecision(NamedTuple):
    """Errors against seconds, and the cheapest setting."""

    trials: tuple[Trial, ...]  # all runs, those that failed or were only foreseen too
    reference: Trial  # the reference run; its error is an estimate
    target: float  # the target error
    limit: float  # the longest explicit step allowed on the scene's own grid [s], the `stable_dt` of the whole motion
    skipped: tuple[str, ...] = ()  # names of the methods for which there was no time

    def cheapest(self, *, explicit: bool | None = None) -> Trial | None:
        """The fastest trial that is good enough: of all, of the explicit ones or of the others; None if none is.

        A trial is good enough if its error is within the target, or, where no trial reaches the target, within 1.25
        times the least error, which is then that of the grid. The error that counts is the largest of three: the
        trial's own, that at the next smaller step (an error that changes sign can be small by luck), and that of the
        reference. An explicit step beyond the limit is never good enough.
        """
        trials = [t for t in self.trials if not (t.method.is_explicit and t.dt * t.refinement > self.limit)]

        def at_next(trial: Trial) -> float:  # the error at the next smaller step that was tried
            same = trial.refinement, name_of(trial.method)
            tried = [t for t in self.trials if (t.refinement, name_of(t.method)) == same]
            finer = [t for t in tried if t.dt < trial.dt and not math.isnan(t.error)]
            return max(finer, key=lambda t: t.dt, default=trial).error

        errors = [max(t.error, at_next(t), self.reference.error) for t in trials]
        enough = max(self.target, 1.25 * min((e for e in errors if e >= 0), default=math.inf))
        good = [t for t, e in zip(trials, errors, strict=True) if e <= enough < math.inf]
        good = [t for t in good if explicit in (None, t.method.is_explicit)]
        return min(good, key=lambda trial: trial.seconds, default=None)

    def verdict(self) -> str:
        """The cheapest setting in words, with the cost of the other kind of method, explicit or implicit."""
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
        text = f"{best} ({best.steps} steps): {best.seconds:.2g} s, error {best.error:.2g}; {other}."
        if best.error > self.target:
            text += f" None reached {self.target:g}: on the grids tried no step does better."
        if best.linearisation_error > LARGEST_LINEARISATION_ERROR:
            text += (
                f" Its linearisation error is up to {100 * best.linearisation_error:.2g} % of the elastic force: for "
                "stresses take Newton's method, where nothing yields, or a shorter step."
            )
        if self.reference.error > self.target / 2:
            text += f" The reference is known to {self.reference.error:.2g} only, and so are the errors."
        if self.reference.refinement == 1:
            text += " There was no time for a finer grid: the errors are those of the step alone."
        if self.skipped:
            text += f" There was no time for {', '.join(self.skipped)}."
        return text


@checked
def work_precision(
    build: Build,
    *,
    t1: Annotated[float, positive, "s"],
    error: Annotated[float, positive] = 1e-2,
    methods: tuple[AbstractIntegrator, ...] = METHODS,
    refinements: tuple[int, ...] = (1, 2),
    also: tuple[tuple[AbstractIntegrator, float], ...] = (),
    most_seconds: Annotated[float, positive] = 60.0,
    progress: Callable[[Trial], None] = lambda trial: None,
    say: Callable[[str], None] = lambda line: None,
) -> WorkPrecision:
    """Run a scene by several methods on several grids, at smaller and smaller steps. A method and grid is done when it
    reaches the target error, gets no better, or costs more than another that reached it.

    Implicit methods start with eight steps in all; explicit ones at the `stable_dt` of the whole reference run, and
    once at twice that, which should fail. A method is not tried on finer grids if others on the scene's own have no
    larger error in no more seconds at all of its steps. No grid is finer than that of the reference run.

    The seconds are those of this machine. Two fifths are for the reference run, the rest is shared equally among
    methods. Runs that would take longer are foreseen from fewer steps; methods that cannot be tried are named.

    *When it breaks*: if refinement does not settle the motion (chaotic contact, PIC at long times), the reference is
    uncertain. Its `error` shows it.

    Args:
        build: makes the scene at 1/n of its spacing, with as many particles a cell, for n = 1, 2, 4, ...
        t1: end time [s].
        error: the target error, relative.
        methods: the methods to try.
        refinements: the grids to try, as values of n.
        also: pairs of a method and a step [s] to try too, on the scene's own grid.
        most_seconds: largest time of all runs, compilation included [s]. A run that has begun is finished.
        progress: called with each trial when it is done.
        say: called with a line on each reference run.

    Raises:
        ValueError: from `prepare`; nothing moves, or no reference run ended well.
    """
    clock, bench = Clock(most_seconds), Bench.of(build, 1, t1)
    limit, reference, truth = settle(build, bench, error, _REFERENCE_SHARE * most_seconds, say)
    trials: list[Trial] = []
    skipped: list[str] = []

    def note(bench: Bench, method: AbstractIntegrator, steps: int, *outcome: float) -> Trial:
        trials.append(Trial(method, bench.refinement, bench.t1 / steps, steps, *outcome))
        progress(trials[-1])
        return trials[-1]

    def tried(bench: Bench, method: AbstractIntegrator, steps: int) -> Trial:
        run = bench.run(method, steps)
        miss = math.inf if run.states is None else bench.motion(run.states).distance(truth)
        return note(bench, method, steps, run.seconds, miss, run.linearisation_error)

    def rival(method: AbstractIntegrator) -> float:
        """Seconds of the cheapest run so far that reached the target, among explicit or implicit ones as the method."""
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

    benches = {1: bench}
    plan = [(n, method) for n, method in itertools.product(refinements, methods) if n <= reference.refinement or n == 1]
    for k, (n, method) in enumerate(plan):
        if n > 1 and 1 in refinements and not method.is_explicit:
            # whether others reach the errors of this method on the scene's own grid in no more seconds
            first = [t for t in trials if t.refinement == 1 and not t.method.is_explicit]
            finished = [t for t in first if t.method is method and math.isfinite(t.error)]
            others = [t for t in first if t.method is not method]
            if all(any(o.error <= _AS_GOOD * t.error and o.seconds <= t.seconds for o in others) for t in finished):
                continue
        if clock.left <= 0:
            skipped.append(name_of(method) + (f" at spacing / {n}" if n > 1 else ""))
            continue
        benches[n] = benches[n] if n in benches else Bench.of(build, n, t1)
        refine(benches[n], method, 1 / (len(plan) - k))
    for method, dt in also:
        tried(bench, method, bench.whole(dt))
    return WorkPrecision(tuple(trials), reference, float(error), limit, tuple(skipped))
