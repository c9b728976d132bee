"""Many searches at once, that differ in where they start or in their data."""

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import require, require_whole
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._search import Iteration, Minimum, begin, jacobian


class Member(NamedTuple):
    """What became of one search."""

    minimum: Minimum | None
    """Where it ended; None where it failed, or was not begun."""
    failure: str = ""
    """Why it failed, in words."""
    joined: int | None = None
    """The number of the search that it came upon, and was ended for."""

    @property
    def interrupted(self) -> bool:
        """Whether it was ended, or not begun, by an interruption."""
        return self.failure == _NOT_BEGUN or (self.minimum is not None and self.minimum.interrupted)


class Problems(eqx.Module):
    """Problems that differ in numbers: the leaves that differ are stacked, the others stored once."""

    varying: Any
    """A problem with the leaves that differ alone, their leading axis the problems."""
    common: Any
    """A problem with the others."""
    shared: bool = eqx.field(static=True)
    """Whether it is one for all searches, and not one for each."""

    @staticmethod
    def of(problems: list[Any], *, shared: bool) -> "Problems":
        """Those of a list.

        Args:
            problems: one for each search, or one for all of them.
            shared: which of the two.

        Raises:
            ValueError: they differ in more than numbers.
        """
        leaves, structures = zip(*(jax.tree.flatten(problem) for problem in problems), strict=True)
        for k, structure in enumerate(structures):
            require(structure == structures[0], _DIFFERENT.format(k))
        if shared:
            nothing = [None] * len(leaves[0])
            return Problems(jax.tree.unflatten(structures[0], nothing), problems[0], True)
        varying: list[Any] = []
        for column in zip(*leaves, strict=True):
            first = column[0]
            if all(leaf is first for leaf in column):
                varying.append(None)
                continue
            numbers = [eqx.is_array_like(leaf) for leaf in column]
            for k, leaf in enumerate(column):
                alike = np.shape(leaf) == np.shape(first) if all(numbers) else leaf == first
                require(bool(alike), _DIFFERENT.format(k))
            same = not all(numbers) or all(np.array_equal(first, leaf, equal_nan=True) for leaf in column)
            varying.append(None if same else np.stack([np.asarray(leaf) for leaf in column]))
        common = [first if stacked is None else None for first, stacked in zip(leaves[0], varying, strict=True)]
        own, rest = (jax.tree.unflatten(structures[0], a) for a in (varying, common))
        return Problems(own, rest, shared)

    def only(self, numbers: list[int]) -> "Problems":
        """Some of them, one for each search."""
        return Problems(self.at(np.array(numbers)), self.common, self.shared)

    def at(self, k: Any) -> Any:
        """What is own to one of them, or to several."""
        return self.varying if self.shared else jax.tree.map(lambda a: a[k], self.varying)

    def one(self, k: int) -> Any:
        """One of them, whole."""
        return eqx.combine(self.at(k), self.common)


def search_many(
    problems: Problems,
    optimiser: AbstractOptimiser,
    starts: Float[np.ndarray, "k n"],
    *,
    sigmas: Problems,
    batch: int,
    joining: float = 0.0,
    settling: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
    begun: Callable[[int, Evaluation], None] | None = None,
) -> tuple[Member, ...]:
    """The minima that many searches find.

    One compiled program makes an iteration of `batch` searches together, by `jax.vmap`. A search that is done leaves
    its place to the next one that waits, so that none is computed in vain until fewer are left than places. One that
    fails ends alone. An interruption (Ctrl-C) ends all where they are.

    Args:
        problems: the problems, or one for all.
        optimiser: the method.
        starts: where each starts.
        sigmas: the noise of each observation, of each problem, or one for all.
        batch: how many are computed together.
        joining: a search that comes so near to another one of one problem with a lower cost, in each coordinate, is
            ended: it would go the same way. Zero ends none.
        settling: a search is at a minimum too where its last three moves, or six iterations, lowered the cost by less
            than this part of it: Gauss-Newton steps are slow where residuals are large, as at false minima. Zero ends
            none.
        progress: called with how many are done, and of how many.
        begun: called with the number of a search and what is known where it starts, unless it fails there.
    """
    count = len(starts)
    lanes = _Lanes(problems, optimiser, np.asarray(starts, float), sigmas, batch)
    waiting, done = deque(range(count)), {}
    try:
        while waiting or lanes.busy:
            while waiting and lanes.free:
                lanes.take(waiting.popleft())
            lanes.advance()
            for lane in lanes.busy:
                first = len(lanes.history[lane]) == 1 and np.isfinite(lanes.history[lane][0].cost)
                if first and begun is not None:
                    begun(lanes.members[lane], lanes.seen[lane])
                ended = lanes.ended(lane, settling)
                if ended is not None:
                    done[lanes.leave(lane)] = ended
            if joining > 0:
                done |= lanes.join(done, joining)
            if progress is not None:
                progress(len(done), count)
    except KeyboardInterrupt:
        done |= {lanes.members[lane]: lanes.stopped(lane, interrupted=True) for lane in lanes.busy}
        done |= {k: Member(None, _NOT_BEGUN) for k in range(count) if k not in done}
    return tuple(done[k] for k in range(count))


def costs_at(
    problem: FitProblem,
    points: Float[np.ndarray, "k n"],
    sigmas: tuple[Array, ...],
    batch: int,
    progress: Callable[[int, int], None] | None = None,
) -> Float[np.ndarray, "k"]:
    """½ Σ r² at many points, without derivatives; NaN where a simulation fails.

    Args:
        problem: the problem.
        points: the coordinates.
        sigmas: the noise of each observation.
        batch: how many are computed together.
        progress: called with how many are done, and of how many.
    """
    costs = np.empty(len(points))
    for first in range(0, len(points), batch):
        own = points[np.minimum(np.arange(first, first + batch), len(points) - 1)]
        costs[first : first + batch] = _costs(problem, own, sigmas)[: len(points) - first]
        if progress is not None:
            progress(min(first + batch, len(points)), len(points))
    return costs


def batch_size(problem: FitProblem, given: int | None, count: int) -> int:
    """How many points or searches of `count` to compute together, unless it is given: eight with explicit steps, where
    they cost less than one by one, and one with implicit ones, where all wait for the slowest solve
    (`benchmarks/multistart.py`).
    """
    if given is not None:
        return min(require_whole("batch", given, 1), count)
    return min(8 if all(e.method.is_explicit for e in problem.experiments) else 1, count)


class _Lanes:
    """Searches that are computed together, each in a place of its own."""

    def __init__(
        self,
        problems: Problems,
        optimiser: AbstractOptimiser,
        starts: np.ndarray,
        sigmas: Problems,
        size: int,
    ):
        self.problems, self.optimiser, self.starts, self.sigmas = problems, optimiser, starts, sigmas
        self.members: list[int] = [-1] * size
        self.z = np.repeat(starts[:1], size, axis=0)
        self.state: Any = None
        self.rest: Any = None
        self.seen: list[Evaluation] = []
        self.history: list[list[Iteration]] = [[] for _ in range(size)]

    @property
    def busy(self) -> list[int]:
        return [lane for lane, member in enumerate(self.members) if member >= 0]

    @property
    def free(self) -> bool:
        return len(self.busy) < len(self.members)

    def take(self, member: int) -> None:
        """Begin a search at a free place."""
        lane = self.members.index(-1)
        z = jnp.asarray(self.starts[member])
        state = begin(self.problems.one(member), self.optimiser, z, self.sigmas.one(member))
        arrays, rest = eqx.partition(state, eqx.is_array)
        if self.state is None:
            self.state = jax.tree.map(lambda a: np.repeat(np.asarray(a)[None], len(self.members), axis=0), arrays)
            self.rest = rest
        self.z[lane] = self.starts[member]
        self._keep(lane, arrays)
        self.members[lane], self.history[lane] = member, []

    def _state(self, lane: int) -> Any:
        return eqx.combine(jax.tree.map(lambda a: a[lane], self.state), self.rest)

    def _keep(self, lane: int, arrays: Any) -> None:
        jax.tree.map(lambda to, a: to.__setitem__(lane, np.asarray(a)), self.state, arrays)

    def advance(self) -> None:
        """An iteration of all; free places repeat one that is busy."""
        spare = self.members[self.busy[0]]
        members = np.array([spare if member < 0 else member for member in self.members])
        state = eqx.combine(self.state, self.rest)
        own, sigmas = self.problems.at(members), self.sigmas.at(members)
        axes = None if self.problems.shared else 0, None if self.sigmas.shared else 0
        z, state, seen = _iterate(
            own, self.problems.common, self.optimiser, self.z, sigmas, self.sigmas.common, state, axes
        )
        arrays, self.rest = eqx.partition(state, eqx.is_array)
        self.z, self.state = np.array(z), jax.tree.map(np.array, arrays)  # copies, which `take` writes to
        seen = jax.tree.map(np.asarray, seen)
        self.seen = [jax.tree.map(lambda a, i=lane: a[i], seen) for lane in range(len(self.members))]
        for lane in self.busy:
            history, cost = self.history[lane], float(self.seen[lane].cost)
            slope = float(np.abs(self.seen[lane].gradient).max())
            moved = not history or cost != history[-1].cost
            history.append(Iteration(len(history), cost, slope, moved, self.z[lane].copy()))
            state = self.optimiser.directed(jnp.asarray(self.z[lane]), self._state(lane), self.seen[lane])
            self._keep(lane, eqx.filter(state, eqx.is_array_like))

    def ended(self, lane: int, settling: float) -> Member | None:
        """What became of a search, once it is done."""
        last = self.history[lane][-1]
        if not np.isfinite(last.cost):
            return Member(None, "the simulation fails where it starts, or does not reach the data")
        if not np.isfinite(last.gradient):
            return Member(None, "there is no derivative")
        if self._settled(lane, settling) or self.optimiser.has_converged(self._state(lane), self.seen[lane]):
            return self.stopped(lane, converged=True)
        return self.stopped(lane) if len(self.history[lane]) == self.optimiser.max_steps else None

    def _settled(self, lane: int, part: float) -> bool:
        """Whether its last moves, or its last iterations, lowered the cost by less than this part."""
        costs = [i.cost for i in self.history[lane]]
        moves = [i.cost for i in self.history[lane] if i.accepted]
        slow = len(moves) > 1 and len(costs) > _ITERATIONS and costs[-1] > (1 - part) * costs[-1 - _ITERATIONS]
        return slow or (len(moves) > _MOVES and moves[-1] > (1 - part) * moves[-1 - _MOVES])

    def stopped(self, lane: int, *, converged: bool = False, interrupted: bool = False) -> Member:
        """A search as it is."""
        member, seen = self.members[lane], self.seen[lane] if self.history[lane] else None
        if seen is None:
            return Member(None, _NOT_BEGUN)
        problem, sigmas = self.problems.one(member), self.sigmas.one(member)
        z = jnp.array(self.z[lane], problem.dtype)  # a copy: `take` writes to self.z
        r, J = seen.residuals, seen.jacobian
        if r is None or J is None:
            r, J = jacobian(problem, z, sigmas)
        found = Minimum(z, jnp.asarray(r), jnp.asarray(J), converged, interrupted, tuple(self.history[lane]))
        return Member(found)

    def leave(self, lane: int) -> int:
        """Make a place free; the member that it had."""
        member, self.members[lane] = self.members[lane], -1
        return member

    def join(self, done: dict[int, Member], within: float) -> dict[int, Member]:
        """End the searches that came upon one with a lower cost, which is done or still goes on."""
        found = {k: m.minimum for k, m in done.items() if m.minimum is not None and m.joined is None}
        at = [(k, found[k].history[-1].cost, found[k].history[-1].z) for k in found]
        busy = [(self.members[lane], self.history[lane][-1].cost, self.z[lane]) for lane in self.busy]
        ended = {}
        for lane, (member, cost, z) in zip(self.busy, busy, strict=True):
            near = [k for k, other, there in at + busy if other < cost and (np.abs(there - z) <= within).all()]
            if near:
                ended[member] = self.stopped(lane)._replace(joined=near[0])
                self.leave(lane)
        return ended


@eqx.filter_jit
def _costs(
    problem: FitProblem, points: Float[np.ndarray, "b n"] | Array, sigmas: tuple[Array, ...]
) -> Float[Array, "b"]:
    """½ Σ r² at some points together, compiled."""

    def cost(z: Coordinates) -> Array:
        r, _ = problem.residuals(z, sigmas, diffrax.ForwardMode())
        return (r**2).sum() / 2

    return jax.vmap(cost)(jnp.asarray(points, problem.dtype))


@eqx.filter_jit
def _iterate(
    own: Any,
    common: Any,
    optimiser: AbstractOptimiser,
    z: Float[np.ndarray, "b n"] | Array,
    sigmas: Any,
    common_sigmas: Any,
    state: Any,
    axes: tuple[int | None, int | None],
) -> tuple[Array, Any, Evaluation]:
    """An optimiser's `iterate` of several searches, compiled.

    Args:
        own: the leaves in which their problems differ.
        common: the others.
        optimiser: the method.
        z: where they are, shape (b, n).
        sigmas: the leaves in which their noise differs.
        common_sigmas: the others.
        state: that of the optimiser, each leaf with a leading axis b.
        axes: whether there is a problem for each, and a noise.
    """

    def one(own: Any, z: Coordinates, sigmas: Any, state: Any) -> tuple[Coordinates, Any, Evaluation]:
        problem: FitProblem = eqx.combine(own, common)
        return optimiser.iterate(problem, z, eqx.combine(sigmas, common_sigmas), state)

    return eqx.filter_vmap(one, in_axes=(axes[0], 0, axes[1], eqx.if_array(0)))(own, z, sigmas, state)


_NOT_BEGUN = "was not begun: the search was interrupted"
_DIFFERENT = (
    "The data sets of an ensemble must differ in numbers alone, but number {} has other shapes, choices or functions "
    "than the first: give each the same times and markers (NaN where nothing was measured), and the same functions."
)
_MOVES = 3
"""How many moves must have lowered the cost by little."""
_ITERATIONS = 6
"""How many iterations must have lowered the cost by little."""
