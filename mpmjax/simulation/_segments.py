"""The adjoint of a rollout whose number of steps is known: reverse mode by segments, in one loop within another."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax.autodiff import recomputed

_MOST_LOOPS = 4
"""Each further loop takes all steps once more."""


class SegmentAdjoint(diffrax.AbstractAdjoint):
    """Reverse mode that stores the state before each segment of steps. From the last segment to the first it computes
    the steps again, storing what each starts from, its sums and what is `kept` of it, and then differentiates them.

    The loops are scans, so that derivatives of any kind and order exist. All steps are taken: nothing stops a run.
    """

    lengths: tuple[int, ...] = eqx.field(static=True)
    """How often each loop turns, the outermost first: the number of segments, then that of their steps; more of them
    where segments have segments. Steps beyond the last one do nothing."""

    def loop(self, *, throw: Any, passed_solver_state: Any, passed_controller_state: Any, **of_diffrax: Any) -> Any:
        del throw, passed_solver_state, passed_controller_state
        return self._loop(inner_while_loop=None, outer_while_loop=self._nested_loops, **of_diffrax)

    def _nested_loops(
        self,
        cond_fun: Callable[[Any], Any],
        body_fun: Callable[[Any], Any],
        state: Any,
        *,
        max_steps: int,
        buffers: Any,
    ) -> Any:
        """The state after all steps, with the arguments of `equinox.internal.while_loop`."""
        del cond_fun, buffers
        turns = math.prod(self.lengths)

        def taken(state: Any) -> Any:
            return jax.tree.map(jnp.asarray, body_fun(state))

        def step(state: Any, number: jax.Array) -> tuple[Any, None]:
            if turns == max_steps:
                return taken(state), None
            return jax.lax.cond(number < max_steps, taken, lambda state: state, state), None

        turn = recomputed(step, sums=True)
        for _ in self.lengths[1:]:
            turn = jax.checkpoint(partial(jax.lax.scan, turn), prevent_cse=False)
        numbers = jnp.arange(turns).reshape(self.lengths)
        return jax.lax.scan(turn, jax.tree.map(jnp.asarray, state), numbers)[0]


def checkpointed(
    steps: int, state_bytes: int, step_bytes: int, budget: int, *, stops: bool = False
) -> diffrax.AbstractAdjoint:
    """The adjoint for reverse mode that computes steps again as seldom as a budget allows: by segments, in up to four
    loops; with less memory diffrax's, whose checkpoints move.

    Args:
        steps: number of steps.
        state_bytes: memory of a state [B].
        step_bytes: memory of what is stored of a step at once, with the state that it starts from [B].
        budget: memory for all of them [B].
        stops: whether a fault may stop the run, which ends diffrax's loop alone.
    """
    for loops in () if stops else range(1, _MOST_LOOPS + 1):
        *outer, inner = _lengths(steps, loops)
        if sum(outer) * state_bytes + inner * step_bytes <= budget:
            return SegmentAdjoint((*outer, inner))
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=max(1, min(steps, budget // state_bytes)))


def _lengths(steps: int, loops: int) -> tuple[int, ...]:
    """The turns of so many loops with as many turns each, if possible none of them for nothing."""
    if loops == 1:
        return (steps,)
    most = _turns(steps, loops)
    inner = next((n for n in range(most, most // 2, -1) if steps % n == 0), most)
    return (*_lengths(math.ceil(steps / inner), loops - 1), inner)


def _turns(steps: int, loops: int) -> int:
    """The number of turns with which so many loops within each other take all steps."""
    return math.ceil(round(steps ** (1 / loops), 6))
