"""Contact: boundaries that push but do not pull.

A *place* of contact is a particle, whose face is before or behind a surface, or a node: of two bodies, of a column
along a contact plane, of a contact of your own. Its gap g and normal impulse r obey g ≥ 0, r ≥ 0, g r = 0; for columns
g is the velocity with which the gap opens, for faces and bodies the gap with its spring's length. The *active set* is
the mask of the places that are held shut, one for each contact.

It is guessed as the places that the solve's guess, or the explicit velocity v*, closes. Then in sweeps: solve with
the active set held; release the places that would have to pull, hold those that are entered; stop when nothing changes,
or `SWEEPS` sets were given up. The conditions that are violated by then are counted in `ContactInfo.violations`. The
derivative is that of a solve with the last set held, and does not exist where the set changes. An explicit step's force
is known at its start, and with it which gaps are shut: it needs no sweep.

Friction is an impulse at the places held, applied after the solve against the slip and at most μ times the normal
impulse (Coulomb). It is not part of the implicit system, so it lags by the elastic response of one step (between bodies
what sticks is: see `BodyContact`). An integrator of several stages may let it act after each (see `TRBDF2`). It takes
the share min(1, limit/(m ‖s‖)) of the slip s. Where that is 1 the node sticks, and the derivative is that of sticking:
d(s after)/ds = 0, at rest too, where s = 0. At the kink, limit = m ‖s‖, it is the one on the side of sticking. Where
nothing pushes there is none of either.
"""

import abc
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from itertools import groupby, permutations
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._conditions import PARALLEL, OwnedImpulse
from mpmjax.potential import AbstractSpring, AbstractTerm, Displacement, Mirror, scattered, with_one_mass

ActiveSet = tuple[Bool[Array, "..."], ...]  # the places that are held, one mask for each contact


class ContactInfo(eqx.Module):
    """The report of contact: how the active set was found."""

    sweeps: Int[Array, "*f"]  # solves beyond one, for active sets that were given up
    violations: Int[Array, "*f"]  # places that pull or are entered all the same


class AbstractContact(eqx.Module):
    """A boundary that pushes but does not pull.

    One of your own is brought by `AbstractBoundary.contacts` and needs `gap_velocity`, `normal_impulse` and, to hold
    components of velocity, `fixed`. The rest has defaults. Their arguments:

    - `held`: the nodes with an active set held.
    - `active`: the places of this contact that are held, shape (n,).
    - `v`: velocity of all nodes [m/s], shape (n, d).
    - `residual`: the impulse that is missing at each node [kg m/s], shape (n, d).
    - `shape`: (n, d).
    """

    representative: ClassVar[Any] = None
    """One node of each place, shape (n,), by which places are counted; None where each node is a place."""

    def known_at_start(self, nodes: Any) -> bool:
        """Whether `likely_held` is the active set of an explicit step. Default: it may not be."""
        return False

    def at(self, share: Scalar) -> "AbstractContact":
        """The contact with its surface where it is after a share of the step. Default: itself, as at rest."""
        return self

    def images(self, active: Array) -> tuple[Any, ...]:
        """The mirrors that stand in the places held. Default: none."""
        return ()

    @abc.abstractmethod
    def gap_velocity(self, held: "ConstrainedNodes", v: NodeVector) -> NodeScalar:
        """The rate at which the gap opens, shape (n,): below zero where it closes, zero where there is no contact. Any
        positive multiple of a velocity will do, such as the momentum of a column."""

    @abc.abstractmethod
    def normal_impulse(self, held: "ConstrainedNodes", residual: NodeVector) -> NodeScalar:
        """The impulse by which the boundary holds each place [kg m/s], shape (n,): below zero where it pulls, and so
        must let go. A boundary that can pull adds the most that it can pull with."""

    def likely_held(self, held: "ConstrainedNodes") -> Bool[Array, "..."]:
        """The places that are held in the first sweep, shape (n,), with nothing held yet. Default: those where the gap
        closes at the explicit velocity v*."""
        return self.gap_velocity(held, held.nodes.explicit_velocity()) < 0

    def rounding(self, held: "ConstrainedNodes", noise: Array) -> tuple[Array, Array]:
        """How far the gap velocity and the normal impulse may lie below zero by rounding, each (n,) or a number, at the
        rounding of a velocity `noise` [m/s]. Default: that, and the rounding of a node's momentum."""
        return noise, noise * held.mass

    def friction(
        self, held: "ConstrainedNodes", active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector] | None:
        """The change of velocity by friction [m/s], shape (n, d), on true nodes, as a function of the velocity v (see
        `friction_change`). Default: None, no friction."""
        return None

    def fixed(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The components of velocity that are zero at the places held, shape (n, d). Default: none."""
        return jnp.zeros(shape, bool)

    def springs(self, active: Array) -> AbstractTerm | None:
        """The springs of the places held. Default: None, without any."""
        return None

    def spring_impulse(self, held: "ConstrainedNodes", active: Array) -> NodeVector | None:
        """The impulse of its springs on all nodes [kg m/s], shape (n, d), not folded at mirrors; None without springs.
        It is that at the displacement of `held`."""
        springs, nodes = self.springs(active), held.unconstrained
        if springs is None:
            return None
        return nodes.dt * scattered([springs.force(held.moved)], held.moved.stencil, len(nodes.mass))

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
        return 0.0


class AbstractSpringContact(AbstractContact):
    """Contact by springs on gaps, ½ k min(g, 0)² at each place (see `Springs` and `Coupling`).

    A place is held if its gap at the end of the step, in an explicit step at its start, is below zero, so that the
    spring pushes and the two conditions exclude each other. The energy is convex in g: a force by the gap at the end
    takes at least as much energy as the spring keeps, −k g¹ (g¹ − g⁰) ≤ ½ k (min(g⁰, 0)² − min(g¹, 0)²), at any step,
    as long as k does not grow. An integrator that evaluates forces at θ of the step's displacement gets the force by
    springs of gap θ g⁰ and stiffness k/θ.
    """

    gap: eqx.AbstractVar[Array]  # g at u = 0 [m]
    stiffness: eqx.AbstractVar[Array]  # k [N/m], in the same shape
    dt: eqx.AbstractVar[Scalar]  # Δt [s]
    share: eqx.AbstractVar[Scalar]  # θ; 1 where forces are those at the start of the step
    near: eqx.AbstractVar[Array]  # whether a place may touch in this step, in the same shape

    def known_at_start(self, nodes: Any) -> bool:
        return True

    def likely_held(self, held: "ConstrainedNodes") -> Array:
        """The places whose gap is below zero at the displacement of `held`."""
        return self.spring_gap(held) < 0

    @abc.abstractmethod
    def spread(self, stretch: Array, stiffness: Array) -> AbstractSpring:
        """The springs of this stretch [m] and stiffness [N/m], each in the shape of the gaps, on the nodes."""

    def springs(self, active: Array) -> AbstractSpring:
        held = active & self.near
        # at θ of the displacement the gap θ g⁰ has become θ g¹: with k/θ the force is −k g¹
        return self.spread(self.share * jnp.where(held, self.gap, 0), jnp.where(held, self.stiffness / self.share, 0))

    def spring_gap(self, held: "ConstrainedNodes") -> Array:
        """The gap at the displacement of `held` [m]; infinite for places that are not near."""
        every = self.springs(jnp.ones(self.gap.shape, bool))
        return jnp.where(self.near, every.stretched(held.moved) / self.share, jnp.inf)

    def gap_velocity(self, held: "ConstrainedNodes", v: NodeVector) -> Array:
        """The gap over the step [m/s]."""
        return self.spring_gap(held) / self.dt

    def normal_impulse(self, held: "ConstrainedNodes", residual: NodeVector) -> Array:
        """The impulse −Δt k g of each spring [kg m/s]; zero at places that are not near."""
        return -self.dt * self.stiffness * jnp.where(self.near, self.spring_gap(held), 0)

    def rounding(self, held: "ConstrainedNodes", noise: Array) -> tuple[Array, Array]:
        return noise, noise * self.stiffness * self.dt**2


class ConstrainedNodes(eqx.Module):
    """The nodes while an active set is held (see `constrain`); `nodes` are `Nodes` of the stepping room. In its methods
    `v` is the velocity of all nodes [m/s] and `residual` the impulse that is missing at each [kg m/s], shape (n, d)."""

    unconstrained: Any  # the nodes of which no contact holds anything
    active: ActiveSet  # the active set
    images: Mirror  # a scaling and the walls that hold nodes, in contact or at all times
    nodes: Any  # the nodes with the active set held
    displacement: NodeVector | None = None
    """The displacement at which forces that are linear in it have their mean over the step [m], shape (n, d), mirrored
    as velocities are; None for none, as in an explicit step."""
    held_by: tuple[int | None, ...] = eqx.field(static=True, default=())
    """The number of the boundary of each wall among the images."""

    @property
    def walls(self) -> list[tuple[int | None, Any]]:
        """The walls among the images, which follow a scaling, with the numbers of their boundaries."""
        return list(zip(self.held_by, self.images.images[1:], strict=True))

    @property
    def mass(self) -> NodeScalar:
        """The nodes' mass, folded on the mirrors [kg], shape (n,)."""
        return self.nodes.mass

    @property
    def moved(self) -> Displacement:
        """`displacement`, of all nodes."""
        return self.unconstrained.potential.displaced(self.displacement)

    def at(self, share: Scalar) -> "ConstrainedNodes":
        """These nodes with surfaces where they are after a share of the step."""
        contacts = tuple(contact.at(share) for contact in self.unconstrained.contacts)
        return replace(self, unconstrained=replace(self.unconstrained, contacts=contacts))

    def beyond_boundaries(self) -> tuple[Mask, tuple[NodeVector, ...]]:
        """The components of velocity that no boundary holds, shape (n, d), and the normals that colliders hold."""
        free = self.unconstrained.free
        reached = [wall.reached(free.shape) for _, wall in self.walls]
        reached += [c.fixed(a, free.shape) for c, a in zip(self.unconstrained.contacts, self.active, strict=True)]
        free = reduce(lambda free, held: free & ~held, reached, free)
        return free, tuple(jnp.where(free, normal, 0) for normal in self.nodes.projection.normals)

    def along_normals(self, residual: NodeVector) -> tuple[OwnedImpulse, ...]:
        """The impulses by which colliders hold nodes along their normals, by the colliders' numbers.

        The residual is the impulse of the prescribed components, plus each collider's times its normal. The direction
        of the last one is at right angles to all others: along it, the residual is the last one's impulse alone, times
        the length of its part.
        """
        if not self.nodes.free_normals:
            return ()
        parts, left = [], self.images.fold(residual)
        for part in reversed(self.nodes.free_normals):
            impulse = ((part.direction * left).sum(axis=1) / part.length)[:, None] * part.normal
            parts.append(OwnedImpulse(impulse, part.owner[:, None]))
            left = left - impulse
        return tuple(parts)

    def without_collider_impulses(self, residual: NodeVector) -> NodeVector:
        """The part of the residual that walls and planes hold, not colliders along their normals."""
        return residual - sum(part.impulse for part in self.along_normals(residual))

    def without_spring_impulses(self, residual: NodeVector) -> NodeVector:
        """The part of the residual that holds components of velocity."""
        nodes, pairs = self.unconstrained, zip(self.unconstrained.contacts, self.active, strict=True)
        springs = [term for contact, active in pairs if (term := contact.springs(active)) is not None]
        if not springs:
            return residual
        moved = self.moved  # of which all springs share one gather
        return residual - nodes.dt * nodes.potential.on_nodes([term.force(moved) for term in springs])

    def impulse(self, residual: NodeVector) -> NodeVector:
        """The impulse of walls, planes and contacts, without colliders, on each true node [kg m/s], shape (n, d)."""
        return self.images.fold(self.without_collider_impulses(residual))

    def violations(self, v: NodeVector, residual: NodeVector) -> tuple[ActiveSet, ActiveSet]:
        """The held places that pull, and the others that are entered, beyond rounding, at the velocity after the
        solve."""
        # a place at rest is neither pulled nor entered: without a margin rounding would flip it in every sweep
        noise = jnp.sqrt(jnp.finfo(v.dtype).eps) * jnp.abs(v).max()
        pulling, entering = [], []
        for contact, active in zip(self.unconstrained.contacts, self.active, strict=True):
            gap, impulse = contact.rounding(self, noise)
            pulling.append(active & (contact.normal_impulse(self, residual) < -impulse))
            entering.append(~active & (contact.gap_velocity(self, v) < -gap))
        return tuple(pulling), tuple(entering)

    def friction(self, v: NodeVector, residual: NodeVector) -> tuple[NodeVector, tuple[NodeVector, ...]]:
        """The velocity after Coulomb friction, and the change of velocity by each contact [m/s].

        Boundaries and pairs of bodies act one after the other: of no more than there are directions in every order, of
        more in the scene's and the reverse, each from the same start. Each contact has the mean of its changes, so that
        none comes first. The mean is within the limit and takes energy, as each is and does. The residual is without
        the impulses of springs.
        """
        tied, nodes, contacts = Mirror(self.nodes.tied), self.nodes, self.unconstrained.contacts
        rubbing = self if nodes.loose is None else replace(self, nodes=nodes.loose)
        pairs = zip(contacts, self.active, strict=True)
        frictions = [contact.friction(rubbing, active, residual) for contact, active in pairs]

        numbers = [-1 - k if number is None else number for k, number in enumerate(nodes.brought_by)]
        forth = [(k, friction) for k, friction in enumerate(frictions) if friction is not None]
        groups = [list(group) for _, group in groupby(forth, key=lambda pair: numbers[pair[0]])]
        orders, by_order = list(permutations(groups)) if len(groups) <= v.shape[1] else [groups, groups[::-1]], []
        for order in orders:
            rubbed, by_contact = v, [jnp.zeros_like(v)] * len(contacts)
            for k, friction in (pair for group in order for pair in group):
                change = friction(tied.unfold(rubbed))
                if tied.images:  # impulses on the nodes of a constrained body act on the whole of it
                    change = nodes.projection.combine(nodes.per_mass(tied.fold(rubbing.mass[:, None] * change)), 0)
                rubbed, by_contact[k] = rubbed + change, change
            by_order.append(by_contact)
        total = [reduce(jnp.add, each) / len(orders) for each in zip(*by_order, strict=True)]
        walls = self.images.images[1:]
        if contacts and walls:
            # v has been unfolded: its changes follow the walls, and are not scaled again. All changes in one pass: the
            # map of a surface takes long to compile
            total = list(jax.vmap(Mirror(walls).unfold)(jnp.stack(total)))
        return sum(total, v), tuple(total)


def constrain(nodes: Any, active: ActiveSet) -> ConstrainedNodes:
    """The nodes with an active set held; no contact may hold anything of them yet."""
    pairs = list(zip(nodes.contacts, active, strict=True))
    # those that hold every column come last: they fill in what lies behind them in columns that contacts release
    brought = [(number, contact.images(mask)) for number, (contact, mask) in zip(nodes.brought_by, pairs, strict=True)]
    each = [(number, wall) for number, walls in (*brought, *enumerate(nodes.walls)) for wall in walls]
    walls = [wall for _, wall in each]
    fixed = nodes.conditions.fixed
    images, order, mass = with_one_mass(walls, nodes.mass, fixed) if walls else (Mirror(()), (), nodes.mass)
    fixed = reduce(jnp.logical_or, (contact.fixed(mask, fixed.shape) for contact, mask in pairs), fixed)
    springs = tuple(term for contact, mask in pairs if (term := contact.springs(mask)) is not None)
    held_by = tuple(each[k][0] for k in order)
    constrained = nodes.constrained(images, mass, fixed, springs)
    return ConstrainedNodes(nodes, active, images, constrained, held_by=held_by)


def count_places(nodes: Any, *sets: ActiveSet) -> Int[Array, ""]:
    """How many places some sets have."""
    pairs = [
        (contact.representative, mask) for part in sets for contact, mask in zip(nodes.contacts, part, strict=True)
    ]
    counts = ((mask if one is None else mask & one).sum().astype(jnp.int32) for one, mask in pairs)
    return sum(counts, jnp.asarray(0, jnp.int32))


def friction_change(
    projection: Any, mass: NodeScalar, normal: Array, velocity: NodeVector | Scalar, limit: NodeScalar
) -> Callable[[NodeVector], NodeVector]:
    """The change of velocity by friction on a surface [m/s], shape (n, d), as a function of the velocity v of all
    nodes: −min(1, limit/(m ‖s‖)) s with the slip s, the part of v − v_c along the surface and in directions that
    nothing else holds.

    Args:
        projection: the projection on what nothing else holds, of the nodes with the active set held.
        mass: their mass m [kg], shape (n,).
        normal: a multiple of the surface's normal, of all nodes or of shape (n, d); zero where it does not push.
        velocity: velocity v_c of the surface [m/s], shape (n, d); zero at rest.
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
    """
    square = (normal**2).sum(axis=-1, keepdims=True)
    unit = normal / jnp.sqrt(jnp.where(square == 0, 1, square))
    limit, free, across = jnp.where(square[..., 0] > 0, limit, 0), projection.free, []
    # what colliders hold and the normal, made orthogonal; one within a hundredth of those before changes nothing
    for along in [*projection.normals, jnp.where(free, unit, 0)]:
        for other in across:
            along = along - other * (other * along).sum(axis=1, keepdims=True)
        length = (along**2).sum(axis=1, keepdims=True)
        some = length > PARALLEL**2
        across.append(jnp.where(some, along / jnp.sqrt(jnp.where(some, length, 1)), 0))

    def change(v: NodeVector) -> NodeVector:
        relative = v - velocity
        slip = jnp.where(free, relative, 0)
        for along in across:
            slip = slip - along * (along * slip).sum(axis=1, keepdims=True)
        # what slides along the surface as another boundary prescribes takes its part of the limit
        whole = slip + jnp.where(free | (unit != 0), 0, relative)
        return -friction_share(whole, mass, limit)[:, None] * slip

    return change


def friction_share(slip: NodeVector, mass: NodeScalar, limit: NodeScalar) -> NodeScalar:
    """The share of the slip s [m/s], shape (n, d), that friction takes, min(1, limit/(m ‖s‖)), shape (n,), of a mass
    [kg] and a largest impulse [kg m/s], shape (n,)."""
    square = (slip**2).sum(axis=1)
    moves = (square > 0) & (mass > 0)
    stopping = mass * jnp.sqrt(jnp.where(moves, square, 1))
    slides = moves & (stopping > limit)
    return jnp.where(slides, limit / jnp.where(slides, stopping, 1), jnp.where((limit > 0) & (mass > 0), 1, 0))
