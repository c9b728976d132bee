"""The result of a grid update, the update with contact, and the impulses of walls and grips."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Int, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative, saved_for_backward, without_derivative
from mpmjax.boundary import ActiveSet, ConstrainedNodes, ContactInfo, constrain, count_places
from mpmjax.implicit import SolveInfo
from mpmjax.potential import Mirror
from mpmjax.stepping._implicit_integrators import AbstractImplicitIntegrator
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes

SWEEPS = 4  # most active sets that are given up in a step


class GridUpdate(eqx.Module):
    """The motion of the nodes over a step, mirrored at active contact planes."""

    motion: NodeMotion  # how the nodes move
    solved: NodeMotion  # `motion` before friction
    elastic: NodeVector | None
    """The impulse of elastic forces (see `AbstractIntegrator.elastic_impulse`) [kg m/s], shape (n, d); None if P2G
    summed momentum and force together."""
    solve: SolveInfo  # the report of the solve
    constrained: ConstrainedNodes | None = None  # the nodes with the active set held; None in a scene without contact
    friction: tuple[NodeVector, ...] = ()  # the change of velocity by the friction of each contact [m/s], shape (n, d)
    contact: ContactInfo | None = None  # the report of contact; None in a scene without it

    def held(self, nodes: Nodes) -> ConstrainedNodes:
        """The nodes with what contacts hold."""
        return constrain(nodes, ()) if self.constrained is None else self.constrained

    def before(self, nodes: Nodes) -> NodeVector:
        """v_i^n with the prescribed values where boundaries and contacts hold [m/s], shape (n, d)."""
        if self.constrained is None:
            return nodes.admitted_velocity()
        return self.constrained.images.unfold(self.constrained.nodes.admitted_velocity())


class StageContact(eqx.Module):
    """Contact in a trapezoidal stage of the length γΔt, with surfaces where they are at its end, and with friction
    there, so that the next stage begins from what sticks."""

    held: ConstrainedNodes  # the nodes with the active set held

    def change(self, share: Scalar) -> NodeVector | None:
        """The force that surfaces so placed add to that of the nodes [N], shape (n, d), with γ; None if all rest."""
        potential, contacts = self.held.nodes.potential, self.held.unconstrained.contacts
        rest, forces = potential.displaced(None), []
        for late, active in zip(contacts, self.held.active, strict=True):
            if (early := late.at(share)) is not late:
                each = (contact.springs(active).force(rest) for contact in (early, late))
                forces.append(jax.tree.map(jnp.subtract, *each))
        return potential.on_nodes(forces) if forces else None

    def friction(self, method: AbstractImplicitIntegrator, v: NodeVector, u: NodeVector, share: Scalar) -> NodeVector:
        """The change of velocity by friction at the end of the stage [m/s], shape (n, d).

        Args:
            method: the integrator.
            v: velocity at the stage's end [m/s], shape (n, d).
            u: displacement at which its last force is taken [m], shape (n, d).
            share: γ [-].
        """
        nodes, rubbed, unfold = self.held.unconstrained, self.held.nodes, self.held.images.unfold
        v, u = unfold(v), unfold(u)
        # what the stage's mean force would do in the whole step gives the limits of the whole step
        motion = NodeMotion(
            nodes.velocity + (v - nodes.velocity) / share,
            resisted=u / (share * nodes.dt) if nodes.potential.viscous else None,
        )
        missing = reaction(nodes, motion, method.elastic_impulse(nodes, motion, ((0.5, None), (0.5, u))))
        # the share γ of an impulse on a mass is that impulse on 1/γ of the mass
        rubbed, loose = (each and replace(each, mass=each.mass / share) for each in (rubbed, rubbed.loose))
        held = replace(self.held.at(share), displacement=u / 2, nodes=replace(rubbed, loose=loose))
        change = held.friction(v, held.without_spring_impulses(missing))[0] - v
        return jnp.where(rubbed.occupied, held.images.unscaled(change), 0)


def constrained_update(nodes: Nodes, method: AbstractIntegrator) -> GridUpdate:
    """The grid update with contact: the active set is searched without derivatives, the solve with it held is
    differentiated, and friction acts after that."""
    guess, violations = method.initial_guess(nodes), None
    start = method.mean_displacement(nodes, NodeMotion(guess))
    nothing_held = ConstrainedNodes(nodes, (), Mirror(()), nodes, start)
    active = tuple(contact.likely_held(nothing_held) for contact in nodes.contacts)
    # the force of an explicit step is known at its start, and with it which gaps are shut
    if method.is_explicit and all(contact.known_at_start(nodes) for contact in nodes.contacts):
        held, sweeps = constrain(nodes, active), jnp.asarray(0, jnp.int32)
        motion, info = _advance(held, method, guess)
    else:
        # the search is iterations: reverse mode stores their result and never differentiates them
        search = saved_for_backward(find_active_set(*without_derivative((nodes, method, active, guess))))
        active, motion, info, sweeps, violations = search
        held = constrain(nodes, active)
        motion, info = _as_advanced((motion, info), held, method)
    held, new, holding = _held_update(held, method, motion, info)
    if violations is None:
        violations = count_places(nodes, *held.violations(new.solved.velocity, holding))
    velocity, friction = held.friction(new.solved.velocity, holding)
    motion = method.with_friction(motion, velocity - motion.velocity)
    return replace(new, motion=motion, friction=friction, contact=ContactInfo(sweeps, violations))


class _Sweep(NamedTuple):
    following: ActiveSet  # the set of the next sweep
    active: ActiveSet
    motion: NodeMotion
    cost: SolveInfo  # of all solves
    given_up: Int[Array, ""]  # sets before this one
    violations: Int[Array, ""]


def find_active_set(
    nodes: Nodes, method: AbstractIntegrator, active: ActiveSet, guess: NodeVector
) -> tuple[ActiveSet, NodeMotion, SolveInfo, Int[Array, ""], Int[Array, ""]]:
    """The active set of contact, the motion with it held, the report of the solves, the number of sets that were given
    up, and of places where it is violated; from a first set and velocity [m/s]. No contact may hold anything of the
    nodes yet. Not to be differentiated: loops have no derivative."""

    def sweep(state: _Sweep) -> _Sweep:
        active = state.following
        held = constrain(nodes, active)
        motion, info = _advance(held, method, state.motion.carrier)
        held, new, holding = _held_update(held, method, motion, info)
        pulls, enters = held.violations(new.solved.velocity, holding)
        # all places are exchanged at once (a primal-dual active set), so that the sweeps do not grow with their number
        following = jax.tree.map(lambda was, pulled, entered: (was & ~pulled) | entered, active, pulls, enters)
        cost, violations = state.cost.followed_by(info), count_places(nodes, pulls, enters)
        return _Sweep(following, active, motion, cost, state.given_up + 1, violations)

    motion, cost = eqx.filter_eval_shape(lambda: _advance(constrain(nodes, active), method, guess))
    motion = jax.tree.map(lambda _: guess, motion)  # all fields of nodes: the first solve starts from the carrier
    cost = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), cost)
    first = _Sweep(active, active, motion, cost, jnp.asarray(-1, jnp.int32), jnp.asarray(1, jnp.int32))
    return jax.lax.while_loop(lambda s: (s.given_up < SWEEPS) & (s.violations > 0), sweep, first)[1:]


def _advance(held: ConstrainedNodes, method: AbstractIntegrator, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
    """The motion of all nodes before friction at the end, and the report of the solve."""
    motion, info = method.advance(replace(held.nodes, inner=StageContact(held)), guess)
    return jax.tree.map(held.images.unfold, motion), info


_as_advanced = custom_derivative(lambda solution, held, method: solution)
"""A solution as it is, with the derivative of `_advance`, which is then solved once more, from there."""


@_as_advanced.defjvp
def _(primals: Any, tangents: Any) -> Any:
    guess = primals[0][0].carrier
    _, change = eqx.filter_jvp(partial(_advance, guess=guess), primals[1:], tangents[1:])
    return _as_advanced(*primals), change


def _held_update(
    held: ConstrainedNodes, method: AbstractIntegrator, motion: NodeMotion, info: SolveInfo
) -> tuple[ConstrainedNodes, GridUpdate, NodeVector]:
    """The nodes with their displacement, their update before friction at the end, and the impulse that holds components
    of velocity [kg m/s], shape (n, d)."""
    nodes, solved = held.unconstrained, motion
    if motion.friction is not None:
        # the equations of the nodes, which say what walls hold, know nothing of an inner stage's friction
        solved = replace(motion, velocity=motion.velocity - motion.friction)
    held = replace(held, displacement=method.mean_displacement(held.nodes, motion))
    elastic = None if nodes.f is None else method.elastic_impulse(nodes, motion)
    holding = held.without_spring_impulses(reaction(nodes, solved, elastic))
    return held, GridUpdate(motion, solved, elastic, info, held), holding


def reaction(nodes: Nodes, motion: NodeMotion, elastic: NodeVector | None) -> NodeVector:
    """The impulse of walls and grips [kg m/s], shape (n, d), by the nodes' motion before friction and its
    `elastic_impulse`; in free components the residual of the solve."""
    if elastic is None:
        return nodes.mass[:, None] * (motion.velocity - nodes.explicit_velocity())
    if motion.resisted is not None:
        elastic = elastic - nodes.dt * nodes.potential.viscous_resistance(motion.resisted)
    return nodes.mass[:, None] * (motion.velocity - nodes.inertial_velocity()) - elastic
