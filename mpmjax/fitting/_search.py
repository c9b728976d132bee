"""Searches for the least sum of squares, one or many together, iteration by iteration."""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import require, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas


class Iteration(NamedTuple):
    """One iteration of a search."""

    number: int
    cost: float  # ½ Σ r² where it is now
    gradient: float  # largest component of its derivative by the coordinates there
    accepted: bool  # whether it moved
    z: np.ndarray  # the coordinates, shape (n,)


class SearchState(NamedTuple):
    """A search after an iteration: all that the next one needs."""

    z: Coordinates
    inner: Any  # state of the optimiser
    seen: Evaluation
    history: tuple[Iteration, ...]  # the iterations so far, one at least


class Minimum(NamedTuple):
    """The end of a search."""

    z: Coordinates
    r: Float[Array, "m"]  # the residuals there [-]
    J: Float[Array, "m n"]  # their derivative
    converged: bool
    interrupted: bool
    history: tuple[Iteration, ...]

    @property
    def cost(self) -> float:
        """½ Σ r²."""
        return self.history[-1].cost


class Member(NamedTuple):
    """The outcome of one search among many."""

    minimum: Minimum | None  # where it ended; None where it failed, or was not begun
    failure: str = ""  # why it failed, in words
    joined: int | None = None  # the number of the search that it came upon, and was ended for

    @property
    def interrupted(self) -> bool:
        """Whether it was ended, or not begun, by an interruption."""
        return self.failure == _NOT_BEGUN or (self.minimum is not None and self.minimum.interrupted)


class NoDerivativeError(RuntimeError):
    """The residuals are finite, their derivative is not."""


class Problems(eqx.Module):
    """Problems, or noises of them, that differ in numbers: leaves that differ are stacked, the others stored once."""

    varying: Any
    """A problem with the leaves that differ alone, their leading axis the problems; no leaves if one serves all."""
    common: Any  # a problem with the others

    @staticmethod
    def of(problems: list[Any]) -> "Problems":
        """Stack a problem for each search, or take one for all of them; they must differ in numbers alone."""
        leaves, structures = zip(*(jax.tree.flatten(problem) for problem in problems), strict=True)
        for k, structure in enumerate(structures):
            require(structure == structures[0], _DIFFERENT.format(k))
        varying = [_stacked(column) for column in zip(*leaves, strict=True)]
        common = [first if stacked is None else None for first, stacked in zip(leaves[0], varying, strict=True)]
        return Problems(*(jax.tree.unflatten(structures[0], part) for part in (varying, common)))

    def at(self, k: Any) -> Any:
        """The varying leaves of one of them, or of several."""
        return jax.tree.map(lambda a: a[k], self.varying)

    def only(self, numbers: list[int]) -> "Problems":
        """Some of them."""
        return Problems(self.at(np.array(numbers)), self.common)

    def one(self, k: int) -> Any:
        """One of them, whole."""
        return eqx.combine(jax.tree.map(jnp.asarray, self.at(k)), self.common)


def _stacked(column: tuple[Any, ...]) -> np.ndarray | None:
    """A leaf of all problems, shape (k, ...); None if it is the same for all."""
    first = column[0]
    if all(leaf is first for leaf in column):
        return None
    numbers = all(eqx.is_array_like(leaf) for leaf in column)
    for k, leaf in enumerate(column):
        require(bool(np.shape(leaf) == np.shape(first) if numbers else leaf == first), _DIFFERENT.format(k))
    if not numbers or all(np.array_equal(first, leaf, equal_nan=True) for leaf in column):
        return None
    return np.stack([np.asarray(leaf) for leaf in column])


def search(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    z: Coordinates,
    sigmas: Sigmas,
    *,
    state: SearchState | None = None,
    report: Callable[[SearchState], None] = lambda state: None,
    begun: Callable[[Evaluation], None] = lambda seen: None,
) -> Minimum:
    """The least Σ r² near z. An interruption (Ctrl-C) ends the search where it is.

    Args:
        problem, optimiser, z, sigmas: what is minimised, how, from where, and with which noise.
        state: in the place of z, the state of an earlier search of the same kind; it is continued exactly.
        report: called after each iteration.
        begun: called with the evaluation where it starts.

    Raises:
        NoDerivativeError: a derivative is not finite.
    """
    converged = interrupted = False
    try:
        while state is None or not (
            (converged := optimiser.has_converged(state.inner, state.seen))
            or optimiser.has_stalled(state.inner)
            or not np.isfinite(state.history[-1].cost)
            or len(state.history) >= optimiser.max_steps
        ):
            state = _step(problem, optimiser, z, sigmas, state)
            last = state.history[-1]
            if np.isfinite(last.cost) and not np.isfinite(last.gradient):
                raise NoDerivativeError
            if last.number == 0 and np.isfinite(last.cost):
                begun(state.seen)
            report(state)
    except KeyboardInterrupt:
        if state is None:
            raise
        interrupted = True
    minimum = _minimum(problem, sigmas, state, converged=converged, interrupted=interrupted)
    if state.seen.jacobian is None and not jnp.isfinite(minimum.J).all():
        raise NoDerivativeError
    return minimum


def search_many(
    problems: Problems,
    optimiser: AbstractOptimiser,
    starts: Float[np.ndarray, "k n"],
    *,
    sigmas: Problems,
    batch: int,
    joining: float = 0.0,
    settling: float = 0.0,
    progress: Callable[[int, int], None] = lambda done, count: None,
    begun: Callable[[int, Evaluation], None] = lambda number, seen: None,
) -> tuple[Member, ...]:
    """The minima of many searches, that differ in where they start or in their data.

    One compiled program makes an iteration of `batch` searches together, by `jax.vmap`. A search that is done leaves
    its place to the next one that waits, so that none is computed in vain until fewer are left than places. One that
    fails ends alone. An interruption (Ctrl-C) ends all where they are.

    Args:
        problems, sigmas: a problem and a noise for each search, or one for all.
        optimiser, starts: how they are minimised, and where each starts.
        batch: how many are computed together.
        joining: a search that comes so near to another one of one problem with a lower cost, in each coordinate, is
            ended: it would go the same way. Zero ends none.
        settling: a search is at a minimum too where its last three moves, or six iterations, lowered the cost by less
            than this part of it: Gauss-Newton steps are slow where residuals are large, as at false minima. Zero ends
            none.
        progress: called with how many are done, and of how many.
        begun: called with the number of a search and the evaluation where it starts, unless it fails there.
    """
    count = len(starts)
    waiting = deque(range(count))
    running: dict[int, SearchState | None] = {}
    done: dict[int, Member] = {}

    def stopped(k: int, state: SearchState, *, converged: bool = False, interrupted: bool = False) -> Member:
        one, noise = problems.one(k), sigmas.one(k)
        return Member(_minimum(one, noise, state, converged=converged, interrupted=interrupted))

    def ended(k: int, state: SearchState) -> Member | None:
        last = state.history[-1]
        if not np.isfinite(last.cost):
            return Member(None, "the simulation fails where it starts, or does not reach the data")
        if not np.isfinite(last.gradient):
            return Member(None, "there is no derivative")
        if _has_settled(state.history, settling) or optimiser.has_converged(state.inner, state.seen):
            return stopped(k, state, converged=True)
        return stopped(k, state) if len(state.history) == optimiser.max_steps else None

    try:
        while waiting or running:
            while waiting and len(running) < batch:
                running[waiting.popleft()] = None
            states = _step_together(problems, optimiser, starts, sigmas, running, batch)
            running = dict(states)
            for k, state in states.items():
                if len(state.history) == 1 and np.isfinite(state.history[0].cost):
                    begun(k, state.seen)
                member = ended(k, state)
                if member is not None:
                    done[k] = member
                    del running[k]
            if joining > 0:
                left = {k: states[k] for k in running}
                for k, other in _joined(done, left, joining).items():
                    done[k] = stopped(k, left[k])._replace(joined=other)
                    del running[k]
            progress(len(done), count)
    except KeyboardInterrupt:
        done |= {k: stopped(k, s, interrupted=True) for k, s in running.items() if s is not None}
    return tuple(done.get(k, Member(None, _NOT_BEGUN)) for k in range(count))


def batch_size(problem: FitProblem, batch: int | None, count: int) -> int:
    """How many points or searches of `count` to compute together. Default: eight with explicit steps, where they cost
    less than one by one, and one with implicit ones, where all wait for the slowest solve (`benchmarks/multistart.py`).
    """
    if batch is not None:
        return min(require_whole("batch", batch, 1), count)
    return min(8 if all(e.method.is_explicit for e in problem.experiments) else 1, count)


def counted(progress: Callable[[str], None] | None, text: str, *, again: bool = True) -> Callable[[int, int], None]:
    """Progress of many in lines, of a text such as "{} of {} searches are done": each time, or whenever more are."""
    told = 0

    def say(done: int, count: int) -> None:
        nonlocal told
        if progress is not None and (again or done > told):
            told = done
            progress(text.format(done, count))

    return say


def _step(
    problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates, sigmas: Sigmas, state: SearchState | None
) -> SearchState:
    """One iteration, the first one at z where there is no state yet."""
    if state is None:
        z = z.astype(float)  # optimistix's own numbers are of JAX's default precision
        inner, history = begin(problem, optimiser, z, sigmas), ()
    else:
        z, inner, _, history = state
    return _recorded(optimiser, *iterate(problem, optimiser, z, sigmas, inner), history)


def _step_together(
    problems: Problems,
    optimiser: AbstractOptimiser,
    starts: Float[np.ndarray, "k n"],
    sigmas: Problems,
    running: dict[int, SearchState | None],
    batch: int,
) -> dict[int, SearchState]:
    """One iteration of several searches, compiled for `batch` of them: free places repeat the first one."""
    if batch == 1:  # the program of a single search, which compiles in less time than a batch of one
        ((k, state),) = running.items()
        return {k: _step(problems.one(k), optimiser, jnp.asarray(starts[k], float), sigmas.one(k), state)}
    z, inners, histories = [], [], []
    for k, state in running.items():
        at = jnp.asarray(starts[k], float) if state is None else state.z
        z.append(np.asarray(at))
        inners.append(begin(problems.one(k), optimiser, at, sigmas.one(k)) if state is None else state.inner)
        histories.append(() if state is None else state.history)
    lanes = [*range(len(z)), *[0] * (batch - len(z))]
    members = np.array(list(running))[lanes]
    parts = [eqx.partition(inner, lambda a: isinstance(a, (jax.Array, np.ndarray, np.generic))) for inner in inners]
    stacked = jax.tree.map(lambda *a: np.stack([np.asarray(a[lane]) for lane in lanes]), *(a for a, _ in parts))
    inner = eqx.combine(stacked, parts[0][1])
    z, inner, seen = iterate_together(
        problems.at(members), problems.common, optimiser, np.stack(z)[lanes], sigmas.at(members), sigmas.common, inner
    )
    arrays, rest = eqx.partition(inner, eqx.is_array)
    z, arrays, seen = (jax.tree.map(np.asarray, a) for a in (z, arrays, seen))
    states = {}
    for lane, (k, history) in enumerate(zip(running, histories, strict=True)):
        at, part, here = (jax.tree.map(lambda a, i=lane: a[i], tree) for tree in (z, arrays, seen))
        states[k] = _recorded(optimiser, jnp.asarray(at), eqx.combine(part, rest), here, history)
    return states


def _recorded(
    optimiser: AbstractOptimiser, z: Coordinates, inner: Any, seen: Evaluation, history: tuple[Iteration, ...]
) -> SearchState:
    """The state after an iteration, which joins the history."""
    cost, slope = float(seen.cost), float(np.abs(seen.gradient).max())
    moved = not history or cost != history[-1].cost
    iteration = Iteration(len(history), cost, slope, moved, np.asarray(z))
    return SearchState(z, optimiser.directed(z, inner, seen), seen, (*history, iteration))


def _minimum(problem: FitProblem, sigmas: Sigmas, state: SearchState, *, converged: bool, interrupted: bool) -> Minimum:
    """Where a search is, with residuals and Jacobian."""
    z = jnp.asarray(state.z).astype(problem.dtype)
    r, J = state.seen.residuals, state.seen.jacobian
    if r is None or J is None:
        r, J = jacobian(problem, z, sigmas)
    return Minimum(z, jnp.asarray(r), jnp.asarray(J), converged, interrupted, state.history)


def _has_settled(history: tuple[Iteration, ...], part: float) -> bool:
    """Whether the last moves, or the last iterations, lowered the cost by less than this part."""
    costs, moves = [i.cost for i in history], [i.cost for i in history if i.accepted]
    slow = len(moves) > 1 and len(costs) > _ITERATIONS and costs[-1] > (1 - part) * costs[-1 - _ITERATIONS]
    return slow or (len(moves) > _MOVES and moves[-1] > (1 - part) * moves[-1 - _MOVES])


def _joined(done: dict[int, Member], running: dict[int, SearchState], within: float) -> dict[int, int]:
    """The searches that came upon one with a lower cost, which is done or still goes on, and which one."""
    ends = {k: m.minimum.history for k, m in done.items() if m.minimum is not None and m.joined is None}
    last = {k: history[-1] for k, history in (ends | {k: s.history for k, s in running.items()}).items()}
    near = {
        k: [n for n, i in last.items() if i.cost < last[k].cost and (np.abs(i.z - last[k].z) <= within).all()]
        for k in running
    }
    return {k: others[0] for k, others in near.items() if others}


@eqx.filter_jit
def begin(problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates, sigmas: Sigmas) -> Any:
    """An optimiser's `begin`, compiled."""
    return optimiser.begin(problem, z, sigmas)


@eqx.filter_jit
def iterate(
    problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates, sigmas: Sigmas, inner: Any
) -> tuple[Coordinates, Any, Evaluation]:
    """An optimiser's `iterate`, compiled."""
    return optimiser.iterate(problem, z, sigmas, inner)


@eqx.filter_jit
def iterate_together(
    varying: Any,
    common: Any,
    optimiser: AbstractOptimiser,
    z: Float[np.ndarray, "b n"] | Array,
    sigmas: Any,
    common_sigmas: Any,
    inner: Any,
) -> tuple[Array, Any, Evaluation]:
    """An optimiser's `iterate` of b searches, compiled: the leaves in which problems and noises differ have a leading
    axis b, like z and the optimiser's state."""

    def one(varying: Any, z: Coordinates, sigmas: Any, inner: Any) -> tuple[Coordinates, Any, Evaluation]:
        problem: FitProblem = eqx.combine(varying, common)
        return optimiser.iterate(problem, z, eqx.combine(sigmas, common_sigmas), inner)

    return eqx.filter_vmap(one, in_axes=(0, 0, 0, eqx.if_array(0)))(varying, z, sigmas, inner)


@eqx.filter_jit
def jacobian(problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> tuple[Array, Array]:
    """The residuals and their Jacobian, compiled."""
    return problem.jacobian(z, sigmas)


_NOT_BEGUN = "was not begun: the search was interrupted"
_DIFFERENT = (
    "The data sets of an ensemble must differ in numbers alone, but number {} has other shapes, choices or functions "
    "than the first: give each the same times and markers (NaN where nothing was measured), and the same functions."
)
_MOVES = 3  # how many moves must have lowered the cost by little
_ITERATIONS = 6  # how many iterations must have lowered the cost by little
