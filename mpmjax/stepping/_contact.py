"""Separation and friction: what the walls that push but do not pull hold, and what friction takes from it.

On such a wall the velocity v and the wall's impulse r along the inward normal obey v ≥ 0, r ≥ 0, v r = 0: for each
component of a node at and beyond a separating box, for each node in a separating collider, where v is relative to the
collider's, and for each column of nodes of a contact plane, where holding means that the column's nodes beyond the
plane mirror those before it. A column's r is the normal impulse of its nodes on the plane and twice that of the images
(a node and its image share equally). Its v is what r works on: the mean, with weights 2 m m'/(m + m'), of the v + v' of
nodes and their images, and of the v of nodes on the plane (where the two are one). So an explicit step that holds the
column has r = −Σ 2 m m'/(m + m') (v* + v*'), and the two conditions exclude each other. Columns that are each other's
image in another plane are held together.

The active set (what the walls hold) is guessed as what the explicit velocity v* drives into them. Then, at most
`SWEEPS` times: solve with the active set held; release what the wall would have to pull, hold what would enter; stop
when nothing changes. What still violates the conditions after that is counted in `ContactInfo.violations`. The last
solve, with the set settled and started from the last sweep's result, is the one that is differentiated; the derivative
is that of the active set found, and does not exist where it changes.

Friction is an impulse at the held nodes after the solve, against the tangential velocity (at a collider, that relative
to it) and at most μ times the normal impulse (Coulomb); it is not part of the implicit system, so it lags by the
elastic response of one step. That of a column acts on its node on the plane, or half a spacing before it.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector
from mpmjax.boundary import Contact, Mirror
from mpmjax.implicit import Projection, SolveInfo, no_solve
from mpmjax.stepping._nodes import Nodes

SWEEPS = 4
"""Most active sets that are tried in a step."""


class ContactInfo(eqx.Module):
    """How the active set was found."""

    sweeps: Int[Array, "*f"]
    """Solves before the last one."""
    violations: Int[Array, "*f"]
    """Wall components, columns and colliders' nodes that pull or are entered all the same."""


def no_contact() -> ContactInfo:
    """The report of a scene without walls that may be left."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    return ContactInfo(zero, zero)


class ActiveSet(eqx.Module):
    """What walls that may be left hold, or a part of it."""

    components: Mask | None
    """Of velocity, at separating boxes, shape (n, d); None without any."""
    columns: tuple[Bool[Array, "n"], ...]
    """For each contact plane its columns, each at all of its nodes."""
    normals: Bool[Array, "n"] | None = None
    """Of nodes in separating colliders; None without any."""


NOTHING = ActiveSet(None, ())
"""What is held where no wall may be left."""


def touches(nodes: Nodes) -> bool:
    """Whether there are walls that may be left."""
    leavable = nodes.conditions.touch is not None and nodes.conditions.touch.leavable is not None
    return nodes.conditions.side is not None or bool(nodes.contacts) or leavable


class Held(eqx.Module):
    """The nodes while an active set is held; see `hold`."""

    unheld: Nodes
    """The nodes of which nothing is held."""
    active: ActiveSet
    """What is held."""
    images: Mirror
    """The mirrors in the columns that are held."""
    nodes: Nodes
    """The nodes with the active set held."""

    @property
    def normal(self) -> NodeVector | None:
        """The free parts of the normals that colliders hold, of length one; None without any."""
        return None if self.unheld.conditions.touch is None else self.nodes.projection.normal

    @property
    def untouched(self) -> Projection:
        """The projection on that in which no boundary has a part."""
        free, normal = self.unheld.free, self.normal
        if self.active.components is not None:
            free = free & ~self.active.components
        for held in self.active.columns:
            free = free & ~held[:, None]
        return Projection(free, None if normal is None else jnp.where(free, normal, 0))

    def pushes(self, momentum_residual: NodeVector) -> NodeScalar | None:
        """The impulse [kg m/s], shape (n,), by which colliders hold each node along their normals, outward positive;
        None without any.

        The momentum residual is push·n and what holds the prescribed components; along the free part of n it is the
        push alone, times the part's length.
        """
        grasp, normal = self.nodes.grasp, self.normal
        if grasp is None or normal is None:
            return None
        return (normal * self.images.fold(momentum_residual)).sum(axis=1) / grasp.reach

    def count_violations(self, v: NodeVector, momentum_residual: NodeVector) -> Int[Array, ""]:
        """How many wall components, columns and colliders' nodes pull or are entered all the same."""
        pulls, enters = self.verdict(v, momentum_residual)
        return _number(self.unheld, pulls) + _number(self.unheld, enters)

    def verdict(self, v: NodeVector, momentum_residual: NodeVector) -> tuple[ActiveSet, ActiveSet]:
        """What of the active set pulls, and what of the rest enters, beyond rounding.

        Args:
            v: velocity of all nodes after the solve [m/s].
            momentum_residual: that of all nodes [kg m/s].
        """
        nodes, active = self.unheld, self.active
        noise = jnp.sqrt(jnp.finfo(v.dtype).eps) * jnp.abs(v).max()
        of_walls = self._beside_colliders(momentum_residual)
        pulls, enters = None, None
        if active.components is not None and nodes.conditions.side is not None:
            push = nodes.conditions.side * self.images.fold(of_walls)
            pulls = active.components & (push < -noise * nodes.mass[:, None])
            if nodes.conditions.touch is not None:
                pulls = pulls | (active.components & self._driven_off(v, noise))
            enters = ~active.components & (nodes.conditions.side * v < -noise)
        pulling, entering = [], []
        for contact, held in zip(nodes.contacts, active.columns, strict=True):
            least = -noise * _tied(nodes, contact, contact.image.column(contact.weight(nodes.mass)))
            pulling.append(held & (_tied(nodes, contact, contact.impulse(of_walls)) < least))
            entering.append(~held & (_approach(nodes, contact, v) < least))
        if active.normals is None:
            return ActiveSet(pulls, tuple(pulling)), ActiveSet(enters, tuple(entering))
        push, departure = self.pushes(momentum_residual), _departure(self.nodes, v)
        assert push is not None and departure is not None
        pulled = active.normals & (push < -noise * self.images.fold_scalar(nodes.mass))
        entered = ~active.normals & (departure < -noise)
        return ActiveSet(pulls, tuple(pulling), pulled), ActiveSet(enters, tuple(entering), entered)

    def wall_friction(self, v: NodeVector, momentum_residual: NodeVector) -> NodeVector:
        """Velocity after Coulomb friction of walls on the held nodes, one wall direction after the other.

        Args:
            v: velocity of all nodes after the solve [m/s].
            momentum_residual: that of all nodes [kg m/s].
        """
        mass = self.images.fold_scalar(self.unheld.mass)
        limit = self._friction_limit(self._beside_colliders(momentum_residual))
        normal, d = self.normal, v.shape[1]
        for a in range(d):
            tangent = jnp.arange(d) != a
            slip = jnp.where(tangent, v, 0)
            slip = slip if normal is None else slip - normal * (normal * slip).sum(axis=1, keepdims=True)
            speed2 = (slip**2).sum(axis=1)
            speed = jnp.sqrt(jnp.where(speed2 == 0, 1, speed2))
            loss = limit[:, a] / jnp.where(mass == 0, 1, mass)
            share = jnp.minimum(loss / speed, 1)
            free = tangent & ~self.unheld.conditions.fixed
            v = v - jnp.where(free & (speed2 > 0)[:, None], share[:, None] * slip, 0)
        return self.images.unfold(v)

    def collider_friction(self, v: NodeVector, push: NodeScalar | None) -> tuple[NodeVector, NodeVector | None]:
        """Velocity after Coulomb friction of colliders on the held nodes, v − min(1, μ push / (m ‖s‖)) s with the slip
        s = Q (v − v_c), and the impulse of it [kg m/s]; None without any.

        Args:
            v: velocity of all nodes after the solve [m/s].
            push: see `pushes`.
        """
        touch, mass = self.unheld.conditions.touch, self.nodes.mass
        if push is None or touch is None or touch.friction is None or self.active.normals is None:
            return v, None
        slip = self.nodes.projection.combine(v - touch.velocity, 0)
        square = (slip**2).sum(axis=1)
        rubbed = self.active.normals & (square > 0) & (mass > 0)
        limit = touch.friction * jnp.maximum(push, 0)
        stopping = mass * jnp.sqrt(jnp.where(rubbed, square, 1))
        share = jnp.where(rubbed, jnp.minimum(limit / jnp.where(rubbed, stopping, 1), 1), 0)
        loss = self.images.unfold(-share[:, None] * slip)
        return v + loss, self.unheld.mass[:, None] * loss

    def _beside_colliders(self, momentum_residual: NodeVector) -> NodeVector:
        """The momentum residual less what colliders hold along their normals: what is left for walls."""
        push, touch = self.pushes(momentum_residual), self.unheld.conditions.touch
        return momentum_residual if push is None or touch is None else momentum_residual - push[:, None] * touch.normal

    def _friction_limit(self, momentum_residual: NodeVector) -> NodeVector:
        """The largest impulse of friction at each node [kg m/s], by the wall's direction, shape (n, d)."""
        limit, components = jnp.zeros_like(momentum_residual), self.active.components
        side, friction = self.unheld.conditions.side, self.unheld.conditions.friction
        if components is not None and side is not None and friction is not None:
            push = jnp.maximum(side * self.images.fold(momentum_residual), 0)
            limit = friction * jnp.where(components, push, 0)
        for contact, held in zip(self.unheld.contacts, self.active.columns, strict=True):
            push = jnp.where(held & contact.at_key, contact.impulse(momentum_residual), 0)
            push = contact.friction * jnp.maximum(self.images.fold_scalar(push), 0)
            limit = limit.at[:, contact.image.axis].add(push)
        return limit

    def _driven_off(self, v: NodeVector, noise: Array) -> Mask:
        """The components of walls from which a collider with the same normal drives the node away, but cannot while
        the wall holds it."""
        touch, grasp, side = self.unheld.conditions.touch, self.nodes.grasp, self.unheld.conditions.side
        assert touch is not None and grasp is not None and side is not None
        blocked = (grasp.normal == 0).all(axis=1) & ((touch.normal * (v - touch.velocity)).sum(axis=1) < -noise)
        return blocked[:, None] & (side * touch.normal > 0)


def hold(nodes: Nodes, active: ActiveSet) -> Held:
    """Nodes of which nothing is held yet, with an active set held."""
    images = Mirror(tuple(c.image.within(held) for c, held in zip(nodes.contacts, active.columns, strict=True)))
    fixed = nodes.conditions.fixed
    if active.components is not None:
        fixed = fixed | active.components
    for contact, columns in zip(nodes.contacts, active.columns, strict=True):
        normal = jnp.arange(fixed.shape[1]) == contact.image.axis
        fixed = fixed | ((columns & contact.on_plane)[:, None] & normal)
    constrained = eqx.tree_at(lambda n: n.conditions.fixed, nodes.folded(images), fixed)
    if active.normals is not None and nodes.conditions.touch is not None:
        gripped = nodes.conditions.touch.held | active.normals
        constrained = eqx.tree_at(lambda n: n.conditions.touch.held, constrained, gripped)
    return Held(unheld=nodes, active=active, images=images, nodes=constrained)


def find_active_set(
    nodes: Nodes,
    guess: NodeVector,
    attempt: Callable[[Held, NodeVector], tuple[NodeVector, NodeVector, NodeVector, SolveInfo]],
) -> tuple[ActiveSet, NodeVector, SolveInfo, Int[Array, ""]]:
    """What the walls hold, a velocity to start the last solve from, and what the sweeps cost.

    Args:
        nodes: nodes of which nothing is held yet.
        guess: where the first solve starts [m/s].
        attempt: (held nodes, guess) to (velocity, momentum residual [kg m/s] of all nodes, guess of the next
            solve, report). Must not be differentiated.

    Returns:
        active set, velocity, the sweeps' reports added up, number of sweeps.
    """

    def sweep(state: tuple) -> tuple:
        active, guess, cost, _, count = state
        held = hold(nodes, active)
        v, momentum_residual, guess, info = attempt(held, guess)
        pulls, enters = held.verdict(v, momentum_residual)
        active = jax.tree.map(lambda was, pulled, entered: (was & ~pulled) | entered, active, pulls, enters)
        return active, guess, cost.followed_by(info), _number(nodes, pulls) + _number(nodes, enters) > 0, count + 1

    def unsettled(state: tuple) -> Array:
        return state[3] & (state[4] < SWEEPS)

    predictor, side = nodes.explicit_velocity(), nodes.conditions.side
    departure = _departure(nodes, predictor)
    active = ActiveSet(
        None if side is None else side * predictor < 0,
        tuple(_approach(nodes, contact, predictor) < 0 for contact in nodes.contacts),
        None if departure is None else departure < 0,
    )
    start = (active, guess, no_solve(guess.dtype), jnp.asarray(True), jnp.asarray(0, dtype=jnp.int32))
    active, guess, cost, _, count = jax.lax.while_loop(unsettled, sweep, start)
    return active, guess, cost, count


def _number(nodes: Nodes, part: ActiveSet) -> Int[Array, ""]:
    """How many components and columns a part has."""
    masks = [held & contact.at_key for contact, held in zip(nodes.contacts, part.columns, strict=True)]
    masks += [mask for mask in (part.components, part.normals) if mask is not None]
    return jnp.asarray(sum(mask.sum() for mask in masks), dtype=jnp.int32)


def _departure(nodes: Nodes, v: NodeVector) -> NodeScalar | None:
    """The velocity [m/s], shape (n,), with which nodes leave the separating collider that they lie in; zero where they
    lie in none, or what is prescribed leaves it no part. None without any."""
    touch, grasp = nodes.conditions.touch, nodes.grasp
    if touch is None or touch.leavable is None or grasp is None:
        return None
    departure = (touch.normal * (v - touch.velocity)).sum(axis=1)
    return jnp.where(touch.leavable & (grasp.normal != 0).any(axis=1), departure, 0)


def _approach(nodes: Nodes, contact: Contact, v: NodeVector) -> NodeScalar:
    """The momentum [kg m/s] with which each column leaves the plane; below zero it enters."""
    return _tied(nodes, contact, contact.departure(nodes.mass, v))


def _tied(nodes: Nodes, contact: Contact, columns: NodeScalar) -> NodeScalar:
    """A quantity of the columns of a plane, summed over columns that are each other's image in other planes."""
    for image in (*(c.image for c in nodes.contacts), *nodes.potential.mirror.images):
        if image.axis != contact.image.axis:
            columns = image.scalar(Mirror((image,)).fold_scalar(columns))
    return columns
