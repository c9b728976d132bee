"""The result of a grid update, the update with contact, and the impulses of walls and grips."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import NodeVector, Scalar
from mpmjax.autodiff import saved_for_backward, without_derivative
from mpmjax.boundary import ConstrainedNodes, ContactInfo, constrain, count_places, find_active_set
from mpmjax.implicit import SolveInfo
from mpmjax.stepping._implicit_integrators import AbstractImplicitIntegrator
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class GridUpdate(eqx.Module):
    """The motion of the nodes over a step, mirrored at active contact planes."""

    motion: NodeMotion
    solved: NodeMotion
    """`motion` before friction."""
    elastic: NodeVector | None
    """The impulse of elastic forces (see `AbstractIntegrator.elastic_impulse`) [kg m/s], shape (n, d); None if P2G
    summed momentum and force together."""
    solve: SolveInfo
    constrained: ConstrainedNodes | None = None
    """The nodes with the active set held; None in a scene without contact."""
    friction: tuple[NodeVector, ...] = ()
    """The change of velocity by the friction of each contact [m/s], shape (n, d)."""
    contact: ContactInfo | None = None

    def held(self, nodes: Nodes) -> ConstrainedNodes:
        """The nodes with what contacts hold."""
        return constrain(nodes, ()) if self.constrained is None else self.constrained

    def before(self, nodes: Nodes) -> NodeVector:
        """v_i^n with the prescribed values where boundaries and contacts hold [m/s], shape (n, d)."""
        if self.constrained is None:
            return nodes.admitted_velocity()
        return self.constrained.images.unfold(self.constrained.nodes.admitted_velocity())


class StageFriction(eqx.Module):
    """Friction at the end of a trapezoidal stage, so that the next stage begins from what sticks."""

    held: ConstrainedNodes
    """The nodes with the active set held."""

    def __call__(self, method: AbstractImplicitIntegrator, v: NodeVector, u: NodeVector, share: Scalar) -> NodeVector:
        """The change of velocity [m/s], shape (n, d), in a stage of the length γΔt.

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
        held = replace(self.held, displacement=u / 2, nodes=replace(rubbed, loose=loose))
        return jnp.where(rubbed.occupied, held.friction(v, held.without_spring_impulses(missing))[0] - v, 0)


def constrained_update(nodes: Nodes, method: AbstractIntegrator) -> GridUpdate:
    """The grid update with contact: the active set is searched without derivatives, the last solve with it held is
    differentiated, and friction acts after that."""

    def solve(
        held: ConstrainedNodes, method: AbstractIntegrator, guess: NodeVector
    ) -> tuple[ConstrainedNodes, NodeMotion, NodeMotion, SolveInfo]:
        motion, info = method.advance(replace(held.nodes, friction=StageFriction(held)), guess)
        motion = solved = jax.tree.map(held.images.unfold, motion)
        if motion.friction is not None:
            solved = replace(motion, velocity=motion.velocity - motion.friction)
        return replace(held, displacement=method.mean_displacement(held.nodes, motion)), motion, solved, info

    frozen, frozen_method, guess = without_derivative((nodes, method, method.initial_guess(nodes)))

    def attempt(held: ConstrainedNodes, guess: NodeVector) -> tuple:
        held, motion, solved, info = solve(held, frozen_method, guess)
        elastic = None if frozen.f is None else frozen_method.elastic_impulse(frozen, motion)
        missing = reaction(frozen, solved, elastic)
        return held, motion.velocity, held.without_spring_impulses(missing), motion.carrier, info

    start = frozen_method.mean_displacement(frozen, NodeMotion(guess))
    zero = jnp.zeros((), guess.dtype)
    none = SolveInfo(residual=zero, report=zero)
    active, guess, cost, sweeps = saved_for_backward(
        find_active_set(frozen, guess, start, attempt, none, explicit=method.is_explicit)
    )
    held, motion, solved, info = solve(constrain(nodes, active), method, guess)
    elastic = None if nodes.f is None else method.elastic_impulse(nodes, motion)
    holding = held.without_spring_impulses(reaction(nodes, solved, elastic))
    velocity, friction = held.friction(solved.velocity, holding)
    contact = ContactInfo(sweeps, count_places(nodes, *held.violations(solved.velocity, holding)))
    motion = method.with_friction(motion, velocity - motion.velocity)
    return GridUpdate(motion, solved, elastic, cost.followed_by(info), held, friction, contact)


def reaction(nodes: Nodes, motion: NodeMotion, elastic: NodeVector | None) -> NodeVector:
    """The impulse of walls and grips [kg m/s], shape (n, d), by the nodes' motion before friction and its
    `elastic_impulse`; in free components the residual of the solve."""
    if elastic is None:
        return nodes.mass[:, None] * (motion.velocity - nodes.explicit_velocity())
    if motion.resisted is not None:
        elastic = elastic - nodes.dt * nodes.potential.viscous_resistance(motion.resisted)
    return nodes.mass[:, None] * (motion.velocity - nodes.inertial_velocity()) - elastic
