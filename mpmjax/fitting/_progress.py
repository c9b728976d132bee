"""Progress of a fit, in lines."""

import time
from collections.abc import Callable

import numpy as np

from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._problem import SHOWN, FitProblem
from mpmjax.fitting._search import SearchState


class Progress:
    """A line an iteration: misfit Σ r², gradient, parameters, seconds, and the time that is left.

    The time left is that of the present search. It is the usual time of an iteration times how many are left: about so
    many as the optimiser's distance from converged needs to fall to one at the rate of the last three iterations, where
    it is known and falls; else at most those up to `max_steps`.
    """

    def __init__(self, problem: FitProblem, optimiser: AbstractOptimiser, say: Callable[[str], None] | None):
        self._problem, self._optimiser, self._say = problem, optimiser, say
        self._durations: list[float] = []
        self._distances: list[float] = []
        self._last = time.perf_counter()

    def begin(self, done: int) -> None:
        """Say that the first iteration begins, which is compiled before.

        Args:
            done: iterations that a log holds already.
        """
        if self._say is None:
            return
        labels, problem = self._problem.labels, self._problem
        named = ", ".join(labels[:SHOWN]) + (", …" if len(labels) > SHOWN else "")
        after = f" after {done} iterations of the log" if done else ""
        count = f"{problem.size} number{'s' * (problem.size > 1)}"
        self._say(f"compiling the fit of {count} ({named}) to {problem.points} that were measured{after}")

    def __call__(self, state: SearchState, seconds: float) -> None:
        """Say where the search stands.

        Args:
            state: after an iteration.
            seconds: since the fit began.
        """
        iteration = state.history[-1]
        if iteration.number == 0:
            self._distances = []
        now = time.perf_counter()
        self._durations.append(now - self._last)
        self._distances.append(self._optimiser.distance(state.inner, state.seen))
        self._last = now
        if self._say is None:
            return
        self._say(
            f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  "
            f"{self._problem.shown(iteration.z)}  {_clock(seconds)}{self._left(len(state.history))}"
        )

    def _left(self, done: int) -> str:
        """The time left, in words; nothing while only the iteration that was compiled is timed, and at the end."""
        most = self._optimiser.max_steps - done
        if len(self._durations) < 2 or most == 0 or self._distances[-1] <= 1:
            return ""
        pace, steps = float(np.median(self._durations[1:])), iterations_left(self._distances)
        if steps is None or steps > most:
            return f", at most {_clock(pace * most)} left"
        return f", about {_clock(pace * steps)} left"


def iterations_left(distances: list[float]) -> int | None:
    """How many iterations the distance needs to fall to one, at the mean rate of its last three values; None where it
    does not fall, or is not known."""
    last = np.asarray(distances[-3:])
    if len(last) < 3 or not (np.isfinite(last).all() and 0 < last[-1] < last[0]):
        return None
    return max(1, int(np.ceil(np.log(last[-1]) / (np.log(last[0] / last[-1]) / 2))))


def _clock(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 100:
        return f"{seconds:.3g} s" if seconds >= 0.1 else "0.1 s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
