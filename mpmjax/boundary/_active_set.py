"""The search for the active set of contact."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Int, NodeVector
from mpmjax.boundary._contact import AbstractNodes, ActiveSet, ConstrainedNodes, constrain, count_places
from mpmjax.potential import Mirror

SWEEPS = 4
"""Most active sets that are tried in a step."""


class ContactInfo(eqx.Module):
    """The report of contact: how the active set was found."""

    sweeps: Int[Array, "*f"]
    """Solves before the last one."""
    violations: Int[Array, "*f"]
    """Places that pull or are entered all the same."""


def find_active_set(
    nodes: AbstractNodes,
    guess: NodeVector,
    start: NodeVector | None,
    attempt: Callable[[ConstrainedNodes, NodeVector], tuple[ConstrainedNodes, NodeVector, NodeVector, NodeVector, Any]],
    cost: Any,
    *,
    explicit: bool = False,
) -> tuple[ActiveSet, NodeVector, Any, Int[Array, ""]]:
    """The active set, a velocity to start the last solve from, the sweeps' reports added up, and their number.

    Args:
        nodes: nodes of which no contact holds anything yet.
        guess: where the first solve starts [m/s], shape (n, d).
        start: a guess of `ConstrainedNodes.displacement` [m], shape (n, d).
        attempt: (constrained nodes, guess) to (constrained nodes with their displacement, velocity, missing impulse
            [kg m/s] of all nodes, guess of the next solve, report). It is not differentiated.
        cost: the report of no solve.
        explicit: whether forces are those at the start of the step.
    """

    def sweep(state: tuple) -> tuple:
        active, guess, cost, _, count = state
        held, v, residual, guess, info = attempt(constrain(nodes, active), guess)
        pulls, enters = held.violations(v, residual)
        active = jax.tree.map(lambda was, pulled, entered: (was & ~pulled) | entered, active, pulls, enters)
        return active, guess, cost.followed_by(info), count_places(nodes, pulls, enters) > 0, count + 1

    predictor = nodes.explicit_velocity()
    nothing_held = ConstrainedNodes(nodes, (), Mirror(()), nodes, start)
    active = tuple(contact.likely_held(nothing_held, predictor) for contact in nodes.contacts)
    none = jnp.asarray(0, dtype=jnp.int32)
    if explicit and all(contact.known_at_start(nodes) for contact in nodes.contacts):
        return active, guess, cost, none
    first = (active, guess, cost, jnp.asarray(True), none)
    active, guess, cost, _, count = jax.lax.while_loop(lambda s: s[3] & (s[4] < SWEEPS), sweep, first)
    return active, guess, cost, count
