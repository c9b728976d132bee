"""Searches for the least sum of squares, one or many together, iteration by iteration, by a method's contract."""

import abc
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.checks import require, require_fields
from mpmjax.fitting._evaluation import Evaluation, evaluated
from mpmjax.fitting._problem import Coordinates, FitProblem


class AbstractOptimiser(eqx.Module):
    """A method that searches the least Σ r², one iteration at a time.

    One of your own gives `begin`, `iterate` and `has_converged`. Its state is a pytree of arrays that says all it
    remembers, so that a search can be written to a file and continued; its `z` are the coordinates where the search is.
    """

    max_steps: eqx.AbstractVar[int]  # most iterations
    __check_init__ = require_fields

    @abc.abstractmethod
    def begin(self, problem: FitProblem, z: Coordinates) -> Any:
        """The state before the first iteration, which starts at z."""

    @abc.abstractmethod
    def iterate(self, problem: FitProblem, state: Any) -> tuple[Any, Evaluation]:
        """One iteration from the state that `begin` or the last iteration returned: the state, and what it knows of
        where it is. The first one evaluates where it starts. No step may end where simulations fail."""

    @abc.abstractmethod
    def has_converged(self, state: Any, seen: Evaluation) -> bool:
        """Whether the search is at a minimum."""

    def place(self, problem: FitProblem, state: Any) -> Coordinates | None:
        """The one place at which the next iteration asks the problem for residuals and Jacobian, where that is all it
        asks for: programs of their own then compute them, in the place of `iterate`. Default: None."""

    def directed(self, before: "Search", state: Any, seen: Evaluation) -> tuple[Any, Evaluation]:
        """An iteration's outcome as the search takes it, outside of what is compiled. Default: as it is."""
        return state, seen

    def distance(self, state: Any, seen: Evaluation) -> float:
        """How far the search is from converged, over where it ends, for the time left. Default: NaN, not known."""
        return float("nan")

    def has_stalled(self, state: Any) -> bool:
        """Whether the search goes no further, and is not known to be at a minimum. Default: the state's `stalled`."""
        return bool(getattr(state, "stalled", False))


class Iteration(NamedTuple):
    """One iteration of a search."""

    number: int
    cost: float  # ½ Σ r² where it is now
    gradient: float  # largest component of its derivative by the coordinates there
    accepted: bool  # whether it moved
    z: np.ndarray  # the coordinates, shape (n,)


class Search(NamedTuple):
    """A search after an iteration, all that the next one needs; and how it ended."""

    z: Coordinates
    inner: Any  # state of the optimiser
    seen: Evaluation  # of the place where it is; with residuals and Jacobian once it has ended
    history: tuple[Iteration, ...]
    converged: bool = False
    interrupted: bool = False  # whether Ctrl-C ended it, or kept it from beginning
    failure: str = ""  # why it came to no end that has residuals and Jacobian, in words
    joined: int | None = None  # the number of the search that it came upon, and was ended for

    @property
    def cost(self) -> float:
        """½ Σ r²."""
        return self.history[-1].cost


def search(problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates) -> Search:
    """The least Σ r² near z; see `search_many`."""
    return search_many([problem], optimiser, {0: z})[0]


def search_many(
    problems: Sequence[FitProblem],
    optimiser: AbstractOptimiser,
    starts: Mapping[int, Any],
    *,
    batch: int = 1,
    joining: float = 0.0,
    settling: float = 0.0,
    state: Search | None = None,
    done: Mapping[int, Search] | None = None,
    enough: Callable[[Search], bool] = lambda search: False,
    progress: Callable[[int, int], None] = lambda done, count: None,
    report: Callable[[FitProblem, Search], None] = lambda problem, search: None,
) -> dict[int, Search]:
    """The least Σ r² of searches that differ in where they start or in their data, by their numbers.

    One compiled program makes an iteration of `batch` searches together; one that is done, or fails, leaves its place
    to the next that waits. An interruption (Ctrl-C) ends all where they are.

    Args:
        problems: that of each number, or one for all searches.
        starts: where each starts, by its number.
        joining: a search that comes so near to another one with a lower cost, in each coordinate, is ended: it would go
            the same way. Zero ends none.
        settling: a search is at a minimum too where its last three moves lowered the cost by less than this part of it,
            since Gauss-Newton steps are slow where residuals are large, or where it goes no further. Zero ends none.
        state: in the place of its start, an earlier state of the first search, which is continued exactly.
        done: earlier searches, by their numbers, which are returned with the others.
        enough: says of each search that has ended whether those that wait are left out.
        progress: called with how many are done, and of how many.
        report: called with the problem and the search after each iteration that did not fail.
    """
    waiting, done, stacked = deque(starts), dict(done or {}), _stacked(problems)
    before, unseen = len(done), Evaluation(jnp.zeros(()), jnp.zeros(0))
    running: dict[int, Search] = {} if state is None else {waiting.popleft(): state}

    def problem_of(k: int) -> FitProblem:
        return problems[0 if len(problems) == 1 else k]

    def end(k: int, **outcome: Any) -> None:
        """End a search; where it did not fail, with the residuals and the Jacobian."""
        search, problem = running[k], problem_of(k)
        if "failure" not in outcome:
            z, r, J = jnp.asarray(search.z).astype(problem.dtype), search.seen.residuals, search.seen.jacobian
            if r is None or J is None:
                r, J = jacobian(problem, z)
            search = search._replace(z=z, seen=search.seen._replace(residuals=jnp.asarray(r), jacobian=jnp.asarray(J)))
            if not np.isfinite(J).all():
                outcome |= {"failure": NO_DERIVATIVE, "converged": False}
        done[k] = search._replace(**outcome)
        del running[k]

    def settled(history: tuple[Iteration, ...]) -> bool:
        moves = [i.cost for i in history if i.accepted]
        return len(moves) > _MOVES and moves[-1] > (1 - settling) * moves[-1 - _MOVES]

    try:
        while True:
            iterated = list(running)
            for k, search in list(running.items()):
                if not np.isfinite(search.cost):
                    end(k, failure="the simulation fails where it starts, or does not reach the data")
                elif not np.isfinite(search.history[-1].gradient):
                    end(k, failure=NO_DERIVATIVE)
                elif settled(search.history) or optimiser.has_converged(search.inner, search.seen):
                    end(k, converged=True)
                elif (stalled := optimiser.has_stalled(search.inner)) or len(search.history) >= optimiser.max_steps:
                    end(k, converged=stalled and settling > 0)
            if joining > 0:
                last = {k: s.history[-1] for k, s in (done | running).items() if not s.failure and s.joined is None}
                for k in list(running):
                    better = (n for n, i in last.items() if i.cost < last[k].cost)
                    near = [n for n in better if (np.abs(last[n].z - last[k].z) <= joining).all()]
                    if near:
                        end(k, joined=near[0])
            if iterated:
                progress(len(done) - before, len(starts))
            if any(enough(done[k]) for k in iterated if k in done):
                waiting.clear()
            while waiting and len(running) < batch:
                k = waiting.popleft()
                z = jnp.asarray(starts[k], float)
                running[k] = Search(z, optimiser.begin(problem_of(k), z), unseen, ())
            if not running:
                return dict(sorted(done.items()))
            running = _iterated(running, problem_of, stacked, optimiser, batch)
            for k, search in running.items():
                if np.isfinite(search.cost) and np.isfinite(search.history[-1].gradient):
                    report(problem_of(k), search)
    except KeyboardInterrupt:
        for k in [k for k, search in running.items() if search.history]:
            end(k, interrupted=True)
    left = Search(jnp.zeros(0), None, unseen, (), interrupted=True, failure="was not begun: the search was interrupted")
    return dict(sorted((dict.fromkeys(starts, left) | done).items()))


def _iterated(
    running: Mapping[int, Search],
    problem_of: Callable[[int], FitProblem],
    stacked: tuple[Any, Any],
    optimiser: AbstractOptimiser,
    batch: int,
) -> dict[int, Search]:
    """One iteration of several searches, compiled for `batch` of them: free places repeat the first one."""
    searches = list(running.values())
    if batch == 1:  # the program of a single search, which compiles in less time than a batch of one
        (k,), (search,) = running, searches
        ends = [iterate(problem_of(k), optimiser, search.inner)]
    else:
        lanes = np.array([*range(len(searches)), *[0] * (batch - len(searches))])
        parts = [eqx.partition(search.inner, eqx.is_array) for search in searches]
        rows = jax.tree.map(lambda *a: np.stack([np.asarray(each) for each in a])[lanes], *(a for a, _ in parts))
        varying = jax.tree.map(lambda a: a[np.array(list(running))[lanes]], stacked[0])
        inner, seen = iterate_together(varying, stacked[1], optimiser, eqx.combine(rows, parts[0][1]))
        arrays, rest = eqx.partition(inner, eqx.is_array)
        whole = jax.tree.map(np.asarray, (arrays, seen))
        each = [jax.tree.map(lambda a, i=lane: a[i], whole) for lane in range(len(searches))]
        ends = [(eqx.combine(part, rest), seen) for part, seen in each]
    after = {}
    for (k, search), end in zip(running.items(), ends, strict=True):
        inner, seen = optimiser.directed(search, *end)
        cost, slope, history = float(seen.cost), float(np.abs(seen.gradient).max()), search.history
        iteration = Iteration(len(history), cost, slope, not history or cost != history[-1].cost, np.asarray(inner.z))
        after[k] = Search(jnp.asarray(inner.z), inner, seen, (*history, iteration))
    return after


def _stacked(trees: Sequence[Any]) -> tuple[Any, Any]:
    """Trees that differ in numbers alone as one with what differs, stacked, shape (k, ...), and one with the others."""
    leaves, structures = zip(*(jax.tree.flatten(tree) for tree in trees), strict=True)

    def check(k: int, same: Any) -> None:
        require(
            bool(same),
            f"The data sets of an ensemble must differ in numbers alone, but number {k} has other shapes, choices or "
            "functions than the first: give each the same times and markers (NaN where nothing was measured), and the "
            "same functions.",
        )

    for k, structure in enumerate(structures):
        check(k, structure == structures[0])
    varying, common = [], []
    for first, *others in zip(*leaves, strict=True):
        different = False
        for k, leaf in enumerate(others, 1):
            if eqx.is_array_like(first) and eqx.is_array_like(leaf):
                check(k, np.shape(leaf) == np.shape(first))
                different |= leaf is not first and not np.array_equal(first, leaf, equal_nan=True)
            else:
                check(k, leaf is first or leaf == first)
        varying.append(np.stack([np.asarray(leaf) for leaf in (first, *others)]) if different else None)
        common.append(None if different else first)
    return jax.tree.unflatten(structures[0], varying), jax.tree.unflatten(structures[0], common)


def batch_size(problem: FitProblem, batch: int | None, count: int) -> int:
    """How many of `count` points or searches to compute together. Default: eight with explicit steps, and one with
    implicit ones, where all wait for the slowest solve (`benchmarks/multistart.py`)."""
    return min(batch or (8 if all(e.method.is_explicit for e in problem.experiments) else 1), count)


def counted(progress: Callable[[str], None] | None, text: str) -> Callable[[int, int], None]:
    """Progress of many in lines, of a text such as "{} of {} searches are done", whenever more are."""
    told = 0

    def say(done: int, count: int) -> None:
        nonlocal told
        if progress is not None and done > told:
            told = done
            progress(text.format(done, count))

    return say


def iterate(problem: FitProblem, optimiser: AbstractOptimiser, inner: Any) -> tuple[Any, Evaluation]:
    """An optimiser's `iterate`, compiled, or what it asks for."""
    place = optimiser.place(problem, inner)
    if place is None or (seen := evaluated(problem, place)) is None:
        return iterate_alone(problem, optimiser, inner)
    return inner, seen


@eqx.filter_jit
def iterate_alone(problem: FitProblem, optimiser: AbstractOptimiser, inner: Any) -> tuple[Any, Evaluation]:
    """An optimiser's `iterate`, compiled."""
    return optimiser.iterate(problem, inner)


# A batch stays one program, though three would serve other observations too: jax dispatches one program in a
# millisecond, three under its transformations in ten, which a bootstrap of short runs pays hundreds of times.
@eqx.filter_jit
def iterate_together(varying: Any, common: Any, optimiser: AbstractOptimiser, inner: Any) -> tuple[Any, Evaluation]:
    """An optimiser's `iterate` of b searches, compiled: all that differs has a leading axis b."""

    def one(varying: Any, inner: Any) -> tuple[Any, Evaluation]:
        return optimiser.iterate(eqx.combine(varying, common), inner)

    return eqx.filter_vmap(one, in_axes=(0, eqx.if_array(0)))(varying, inner)


def jacobian(problem: FitProblem, z: Coordinates) -> tuple[Array, Array]:
    """The residuals and their Jacobian, compiled."""
    if problem.cheaper_mode == "forward" and (seen := evaluated(problem, z)) is not None:
        return jnp.asarray(seen.residuals), jnp.asarray(seen.jacobian)
    return _jacobian(problem, z)


_jacobian = eqx.filter_jit(lambda problem, z: problem.jacobian(z))

NO_DERIVATIVE = "there is no derivative"
_MOVES = 3  # how many moves must have lowered the cost by little
