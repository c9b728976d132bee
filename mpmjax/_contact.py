"""Separation and friction: which wall nodes hold, and what friction takes from them.

On a separating wall the velocity v and the wall's impulse r along the inward normal obey v ≥ 0, r ≥ 0, v r = 0. The
active set (the nodes the wall holds) is guessed as those the explicit velocity v* drives into the wall. Then, at most
`SWEEPS` times: solve with the active nodes held; release those the wall would have to pull, hold those that would
enter; stop when nothing changes. What still violates the conditions after that is counted in `ContactInfo.violations`.
The last solve, with the set settled and started from the last sweep's result, is the one that is differentiated; the
derivative is that of the active set found, and does not exist where it changes.

Friction is an impulse at the held nodes after the solve, against the tangential velocity and at most μ times the normal
impulse (Coulomb); it is not part of the implicit system, so it lags by the elastic response of one step.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._boundary import Conditions
from mpmjax._implicit import SolveInfo, no_solve
from mpmjax._types import Array, Int, Mask, NodeScalar, NodeVector

SWEEPS = 4
"""Most active sets that are tried in a step."""


class ContactInfo(eqx.Module):
    """How the active set was found."""

    sweeps: Int[Array, "*f"]
    """Solves before the last one."""
    violations: Int[Array, "*f"]
    """Wall components that pull or are entered all the same."""


def no_contact() -> ContactInfo:
    """The report of a scene without separating walls."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    return ContactInfo(zero, zero)


def _verdict(side: NodeVector, active: Mask, v: NodeVector, impulse: NodeVector, mass: NodeScalar) -> tuple[Mask, Mask]:
    """Which active components pull, and which inactive ones enter, beyond rounding."""
    noise = jnp.sqrt(jnp.finfo(v.dtype).eps) * jnp.abs(v).max()
    pulls = active & (side * impulse < -noise * mass[:, None])
    enters = ~active & (side * v < -noise)
    return pulls, enters


def find_active_set(
    conditions: Conditions,
    predictor: NodeVector,
    guess: NodeVector,
    mass: NodeScalar,
    try_set: Callable[[Mask, NodeVector], tuple[NodeVector, NodeVector, SolveInfo]],
) -> tuple[Mask, NodeVector, SolveInfo, Int[Array, ""]]:
    """The components that separating walls hold, a velocity to start the last solve from, and what the sweeps cost.

    Args:
        conditions: of the step, with separating walls.
        predictor: explicit velocity v* [m/s].
        guess: where the first solve starts [m/s].
        mass: nodal mass [kg].
        try_set: (active, guess) to (velocity, wall impulse [kg m/s], report). Must not be differentiated.

    Returns:
        active set, velocity, the sweeps' reports added up, number of sweeps.
    """
    side = conditions.side
    assert side is not None

    def sweep(state: tuple) -> tuple:
        active, v, cost, _, count = state
        v, impulse, info = try_set(active, v)
        pulls, enters = _verdict(side, active, v, impulse, mass)
        return (active & ~pulls) | enters, v, cost.plus(info), (pulls | enters).any(), count + 1

    def unsettled(state: tuple) -> Array:
        return state[3] & (state[4] < SWEEPS)

    active = side * predictor < 0
    start = (active, guess, no_solve(guess.dtype), jnp.asarray(True), jnp.asarray(0, dtype=jnp.int32))
    active, v, cost, _, count = jax.lax.while_loop(unsettled, sweep, start)
    return active, v, cost, count


def count_violations(
    conditions: Conditions, active: Mask, v: NodeVector, impulse: NodeVector, mass: NodeScalar
) -> Int[Array, ""]:
    """How many wall components pull or are entered all the same."""
    assert conditions.side is not None
    pulls, enters = _verdict(conditions.side, active, v, impulse, mass)
    return (pulls | enters).sum().astype(jnp.int32)


def with_friction(
    conditions: Conditions, active: Mask, v: NodeVector, impulse: NodeVector, mass: NodeScalar
) -> NodeVector:
    """Velocity after Coulomb friction on the held nodes, one wall direction after the other."""
    assert conditions.side is not None and conditions.friction is not None
    d = v.shape[1]
    for a in range(d):
        tangent = jnp.arange(d) != a
        slip = jnp.where(tangent, v, 0)
        speed2 = (slip**2).sum(axis=1)
        speed = jnp.sqrt(jnp.where(speed2 == 0, 1, speed2))
        pressure = jnp.where(active[:, a], jnp.maximum(conditions.side[:, a] * impulse[:, a], 0), 0)
        loss = conditions.friction[:, a] * pressure / jnp.where(mass == 0, 1, mass)
        share = jnp.minimum(loss / speed, 1)
        free = tangent & ~conditions.fixed
        v = v - jnp.where(free & (speed2 > 0)[:, None], share[:, None] * slip, 0)
    return v
