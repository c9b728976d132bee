"""Contact: boundaries that push but do not pull.

A place of such a boundary is a particle, whose face is before or behind a surface; for a contact plane a column of
nodes, described at all of its nodes; for a contact of one's own a node. Its gap g and the normal impulse r obey g ≥ 0,
r ≥ 0, g r = 0; for columns and nodes g is the velocity with which the gap opens. For particles this holds of the gap
with its spring's length (see `Springs`). The *active set* is the mask of the places that are held shut, one for each
contact, of shape (p,) or (n,).

The active set is guessed as the places that the start of the step, or the explicit velocity v*, closes. Then, at most
`SWEEPS` times: solve with the active set held; release the places that would have to pull, hold those that are entered;
stop when nothing changes. The conditions that are violated after that are counted in `ContactInfo.violations`. The last
solve, with the set settled and started from the last sweep's result, is the one that is differentiated: its derivative
is that of the active set found, and does not exist where the set changes. An explicit step's force is known at its
start, and with it which faces are behind their surface: it needs no sweep.

Friction is an impulse at the places held, applied after the solve against the tangential velocity (at a collider, that
relative to it) and at most μ times the normal impulse (Coulomb). It is not part of the implicit system, so it lags by
the elastic response of one step.
"""

import abc
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector
from mpmjax.boundary._conditions import Conditions, Given
from mpmjax.potential import AbstractTerm, Displacement, Image, Mirror, scattered

ActiveSet = tuple[Bool[Array, "..."], ...]
"""The places that are held, one mask for each contact."""


class AbstractNodes(eqx.Module):
    """The interface of a step's nodes to contact."""

    mass: eqx.AbstractVar[NodeScalar]
    """m_i [kg], shape (n,)."""
    conditions: eqx.AbstractVar[Conditions]
    """The prescribed motion."""
    dt: eqx.AbstractVar[Array]
    """Δt [s]."""
    potential: eqx.AbstractVar[Any]
    """The potential Φ of the nodes' displacement."""
    contacts: eqx.AbstractVar[tuple["AbstractContact", ...]]
    """The boundaries that may be left."""
    loose: eqx.AbstractVar[Any]
    """The nodes with those of rigid bodies each by itself; None without rigid bodies."""

    @property
    @abc.abstractmethod
    def free(self) -> Mask:
        """The components of velocity that nothing prescribes, on nodes that have mass, shape (n, d)."""

    @property
    @abc.abstractmethod
    def free_normals(self) -> tuple[Any, ...]:
        """The free parts of the colliders' normals."""

    @property
    @abc.abstractmethod
    def projection(self) -> Any:
        """The projection on what nothing holds."""

    @property
    @abc.abstractmethod
    def mirror(self) -> Mirror:
        """The mirror images of symmetry planes, and of the columns that are held."""

    @abc.abstractmethod
    def constrained(
        self: "N",
        images: Mirror,
        fixed: Mask,
        terms: tuple[AbstractTerm, ...],
    ) -> "N":
        """These nodes with more of them held.

        Args:
            images: mirrors on which the nodes are folded.
            fixed: components of velocity that are prescribed, shape (n, d).
            terms: the springs of what is held by springs, which are added to the potential.
        """

    @abc.abstractmethod
    def explicit_velocity(self) -> NodeVector:
        """v* [m/s], shape (n, d)."""


N = TypeVar("N", bound=AbstractNodes)


class AbstractContact(eqx.Module):
    """A boundary that pushes but does not pull.

    One of one's own is brought by `AbstractBoundary.contacts` and needs `gap_velocity`, `normal_impulse` and, to hold
    components of velocity, `fixed`. The rest has defaults.
    """

    @property
    def collider(self) -> int | None:
        """The number of the collider that receives its impulse by springs and friction; None if none does."""
        return None

    @property
    def friction_order(self) -> float:
        """Frictions act one after the other, from the lowest number on, those of one number forth and back: that of a
        wall is its axis, of a contact plane its axis and a half, of colliders 3. Default: 4, after all of these."""
        return 4.0

    @property
    def known_at_start(self) -> bool:
        """Whether `likely_held` is the active set of a step whose force is that at its start. Default: False."""
        return False

    @property
    def mirror_image(self) -> Image | None:
        """The mirror that stands in the places held; None without one."""
        return None

    @abc.abstractmethod
    def gap_velocity(self, held: "ConstrainedNodes", v: NodeVector) -> NodeScalar:
        """The rate at which the gap opens, shape (n,): below zero where it closes, zero where there is no contact. Any
        positive multiple of a velocity will do, such as the momentum of a column.

        Args:
            held: the nodes with an active set held.
            v: velocity of all nodes [m/s], shape (n, d).
        """

    @abc.abstractmethod
    def normal_impulse(self, held: "ConstrainedNodes", residual: NodeVector) -> NodeScalar:
        """The impulse by which the boundary holds each place [kg m/s], shape (n,): below zero where it pulls, and so
        must let go. A boundary that can pull adds the most that it can pull with.

        Args:
            held: the nodes with an active set held.
            residual: the impulse that is missing at each node [kg m/s], shape (n, d).
        """

    def likely_held(self, held: "ConstrainedNodes", v: NodeVector) -> Bool[Array, "n"]:
        """The places that are held in the first sweep, shape (n,). Default: those where the gap closes.

        Args:
            held: the nodes with nothing held.
            v: the explicit velocity v* of all nodes [m/s], shape (n, d).
        """
        return self.gap_velocity(held, v) < 0

    def rounding(self, held: "ConstrainedNodes", noise: Array) -> tuple[Array, Array]:
        """How far the gap velocity and the normal impulse may lie below zero by rounding, each (n,) or a number.
        Default: the rounding of a velocity, and of a node's momentum.

        Args:
            held: the nodes with an active set held.
            noise: the rounding of a velocity [m/s].
        """
        return noise, noise * held.mass

    def friction(self, held: "ConstrainedNodes", active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        """The change of velocity by friction [m/s], shape (n, d), on true nodes. Default: none.

        Args:
            held: the nodes with the active set held.
            active: the places of this contact that are held, shape (n,).
            v: velocity of all nodes [m/s], shape (n, d).
            residual: the impulse that is missing at each node [kg m/s], shape (n, d).
        """
        del held, active, residual
        return jnp.zeros_like(v)

    def fixed(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The components of velocity that are zero at the places held, shape (n, d). Default: none.

        Args:
            active: the places of this contact that are held, shape (n,).
            shape: (n, d).
        """
        del active
        return jnp.zeros(shape, bool)

    def springs(self, active: Array) -> AbstractTerm | None:
        """The springs of the places held; None without any, which is the default."""
        del active
        return None

    def spring_impulse(self, held: "ConstrainedNodes", active: Array) -> NodeVector | None:
        """The impulse of its springs on all nodes [kg m/s], shape (n, d), not folded at mirrors; None without springs.

        Args:
            held: the nodes with the active set held, and their displacement.
            active: the places of this contact that are held.
        """
        springs, nodes = self.springs(active), held.unheld
        return (
            None
            if springs is None
            else nodes.dt * scattered([springs.force(held.moved)], held.moved.stencil, len(nodes.mass))
        )

    @staticmethod
    def stability_rate(
        contacts: tuple[Any, ...], nodal_mass: NodeScalar, mass: Array, steepness: Array
    ) -> Array | float:
        """z [1/s²] of each particle, or a number, that the springs of all contacts of this kind add to the left side
        of the bound Δt² z ≤ 4 of `stable_dt`, whether they are shut now or may be in a step to come. Default: 0.

        Args:
            contacts: the contacts of this kind.
            nodal_mass: masses of the nodes m_i [kg], shape (n,).
            mass: masses of the particles [kg], shape (p,).
            steepness: A [1/m²] of each particle (see `stable_dt`).
        """
        del contacts, nodal_mass, mass, steepness
        return 0.0

    def reached(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The components of velocity on which the held places act, shape (n, d). Default: those of `fixed`."""
        return self.fixed(active, shape)

    def representative(self) -> Bool[Array, "n"] | None:
        """One node of each place, shape (n,), by which places are counted; None where each node is a place."""
        return None


class ConstrainedNodes(eqx.Module, Generic[N]):
    """The nodes while an active set is held; see `constrain`."""

    unheld: N
    """The nodes of which no contact holds anything."""
    active: ActiveSet
    """The active set."""
    images: Mirror
    """The mirrors in the columns that are held."""
    nodes: N
    """The nodes with the active set held."""
    displacement: NodeVector | None = None
    """The displacement at which forces that are linear in it have their mean over the step [m], shape (n, d), mirrored
    as velocities are; None for none, as in an explicit step."""

    @property
    def normals(self) -> tuple[NodeVector, ...]:
        """Unit vectors at right angles along which colliders hold nodes, each (n, d)."""
        return self.nodes.projection.normals

    @property
    def mass(self) -> NodeScalar:
        """The nodes' mass, folded on the mirrors [kg], shape (n,)."""
        return self.images.fold_scalar(self.unheld.mass)

    @property
    def moved(self) -> Displacement:
        """`displacement`, of all nodes."""
        return self.unheld.potential.displaced(self.displacement)

    def beyond_boundaries(self) -> tuple[Mask, tuple[NodeVector, ...]]:
        """The components of velocity on which no boundary acts, shape (n, d), and the normals that colliders hold."""
        free = self.unheld.free
        for contact, active in zip(self.unheld.contacts, self.active, strict=True):
            free = free & ~contact.reached(active, free.shape)
        return free, tuple(jnp.where(free, normal, 0) for normal in self.normals)

    def along_normals(self, residual: NodeVector) -> tuple[Given, ...]:
        """The impulses by which colliders hold nodes along their normals, by the colliders' numbers.

        Args:
            residual: the impulse that is missing at each node [kg m/s], shape (n, d). It is what holds the prescribed
                components, plus each collider's impulse times its normal. The direction of the last one is at right
                angles to all others: along it, it is the last one's impulse alone, times the length of its part.
        """
        given, left = [], self.images.fold(residual)
        for part in reversed(self.nodes.free_normals):
            impulse = ((part.direction * left).sum(axis=1) / part.length)[:, None] * part.normal
            given.append(Given(impulse, part.owner[:, None]))
            left = left - impulse
        return tuple(given)

    def beside_colliders(self, residual: NodeVector) -> NodeVector:
        """The residual without what colliders hold along their normals: what walls and planes hold."""
        return residual - sum(part.impulse for part in self.along_normals(residual))

    def impulse(self, residual: NodeVector) -> NodeVector:
        """The impulse of walls, planes and contacts, without colliders, on each true node [kg m/s], shape (n, d).

        Args:
            residual: the impulse that is missing at each node [kg m/s], shape (n, d).
        """
        return self.images.fold(self.beside_colliders(residual))

    def violations(self, v: NodeVector, residual: NodeVector) -> tuple[ActiveSet, ActiveSet]:
        """The held places that pull, and the others that are entered, beyond rounding.

        Args:
            v: velocity of all nodes after the solve [m/s], shape (n, d).
            residual: the impulse that is missing at each node [kg m/s], shape (n, d).
        """
        noise = jnp.sqrt(jnp.finfo(v.dtype).eps) * jnp.abs(v).max()
        pulling, entering = [], []
        for contact, active in zip(self.unheld.contacts, self.active, strict=True):
            gap, impulse = contact.rounding(self, noise)
            pulling.append(active & (contact.normal_impulse(self, residual) < -impulse))
            entering.append(~active & (contact.gap_velocity(self, v) < -gap))
        return tuple(pulling), tuple(entering)

    def count_violations(self, v: NodeVector, residual: NodeVector) -> Int[Array, ""]:
        """How many places pull or are entered."""
        return count_places(self.unheld, *self.violations(v, residual))

    def beside_springs(self, residual: NodeVector) -> NodeVector:
        """The residual without the impulses of springs: what holds components of velocity.

        Args:
            residual: the impulse that is missing at each node [kg m/s], shape (n, d).
        """
        for contact, active in zip(self.unheld.contacts, self.active, strict=True):
            impulse = contact.spring_impulse(self, active)
            residual = residual if impulse is None else residual - self.unheld.mirror.fold(impulse)
        return residual

    def friction(self, v: NodeVector, residual: NodeVector) -> tuple[NodeVector, tuple[NodeVector, ...]]:
        """The velocity after Coulomb friction, one contact after the other, and the change of velocity by each [m/s].

        Contacts of one `friction_order` act in the scene's order and, from the same start, against it; each has the
        mean of its two changes, so that of two none comes first. The mean is within the limit and takes energy, as both
        are and do.

        Args:
            v: velocity of all nodes after the solve [m/s], shape (n, d).
            residual: the impulse that holds components of velocity [kg m/s], shape (n, d).
        """
        loosened, tied, nodes = self._loosened(), Mirror(self.nodes.mirror.rigid), self.nodes
        contacts = self.unheld.contacts

        def changes(order: Sequence[int]) -> list[NodeVector]:
            rubbed, by_contact = v, [v] * len(contacts)
            for k in order:
                change = contacts[k].friction(loosened, self.active[k], tied.unfold(rubbed), residual)
                if tied.images:  # the impulses on a rigid body's nodes are those on the whole of it
                    mass, impulse = nodes.mass[:, None], tied.fold(loosened.nodes.mass[:, None] * change)
                    change = nodes.projection.combine(jnp.where(mass > 0, impulse / jnp.where(mass > 0, mass, 1), 0), 0)
                rubbed, by_contact[k] = rubbed + change, change
            return by_contact

        forth = list(range(len(contacts)))
        back = sorted(forth, key=lambda k: (contacts[k].friction_order, -k))
        total = changes(forth)
        if back != forth:
            total = [(a + b) / 2 for a, b in zip(total, changes(back), strict=True)]
        return self.images.unfold(sum(total, v)), tuple(map(self.images.unfold, total))

    def pushes(self, slowed: tuple[NodeVector, ...]) -> tuple[tuple[int, NodeVector], ...]:
        """The impulses of colliders on the nodes by springs and friction [kg m/s], each with the collider's number.

        Args:
            slowed: the change of velocity by the friction of each contact [m/s], shape (n, d).
        """
        found, mass, tied = [], self._loosened().unheld.mass, Mirror(self.nodes.mirror.rigid)
        for contact, active, change in zip(self.unheld.contacts, self.active, slowed, strict=True):
            if contact.collider is not None:
                rubbed, impulse = mass[:, None] * tied.unfold(change), contact.spring_impulse(self, active)
                found.append((contact.collider, rubbed if impulse is None else rubbed + impulse))
        return tuple(found)

    def _loosened(self) -> "ConstrainedNodes":
        """The nodes with those of rigid bodies each by itself, as friction acts on them; gaps are those with the
        bodies rigid."""
        loose = self.unheld.loose
        if loose is None:
            return self
        unheld = eqx.tree_at(lambda n: (n.mass, n.conditions.fixed), self.unheld, (loose.mass, loose.conditions.fixed))
        return replace(self, unheld=unheld, nodes=loose)


def constrain(nodes: N, active: ActiveSet) -> ConstrainedNodes[N]:
    """The nodes with an active set held.

    Args:
        nodes: nodes of which no contact holds anything yet.
        active: what is held.
    """
    pairs = list(zip(nodes.contacts, active, strict=True))
    images = Mirror(tuple(image.within(mask) for contact, mask in pairs if (image := contact.mirror_image) is not None))
    fixed = nodes.conditions.fixed
    for contact, mask in pairs:
        fixed = fixed | contact.fixed(mask, fixed.shape)
    springs = tuple(term for contact, mask in pairs if (term := contact.springs(mask)) is not None)
    return ConstrainedNodes(nodes, active, images, nodes.constrained(images, fixed, springs))


def count_places(nodes: AbstractNodes, *sets: ActiveSet) -> Int[Array, ""]:
    """How many places some sets have."""
    total = jnp.asarray(0, dtype=jnp.int32)
    for part in sets:
        for contact, mask in zip(nodes.contacts, part, strict=True):
            one = contact.representative()
            total = total + (mask if one is None else mask & one).sum().astype(jnp.int32)
    return total
