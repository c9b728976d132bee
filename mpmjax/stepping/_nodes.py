"""The nodes at the start of a step: mass, velocity and force from P2G, boundaries, and the elastic potential."""

from dataclasses import replace
from functools import reduce
from operator import attrgetter

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, Scalar, components
from mpmjax.boundary import (
    PARALLEL,
    AbstractContact,
    AbstractNodes,
    Conditions,
    Coupling,
    Mirror,
    MirrorMotion,
    Springs,
    brought_contacts,
    combined_conditions,
    mirror,
    mirror_motion,
)
from mpmjax.discretisation import Stencil, p2g, scatter
from mpmjax.implicit import ElasticPotential, Projection
from mpmjax.state import Particles, Scene, load_force, points_of, supports_of
from mpmjax.stepping._body_surfaces import contacts_of_bodies
from mpmjax.stepping._nodal_sums import JoinedSum, SeparateSums, per_mass
from mpmjax.stepping._particle_faces import faces_of
from mpmjax.stepping._rigid_layers import RigidLayers, rigid_layers


class FreeNormal(eqx.Module):
    """A collider's normal at each node, and its part in free components at right angles to those of earlier ones."""

    normal: NodeVector
    """The collider's unit normal, shape (n, d)."""
    owner: Int[Array, "n"]
    """The collider's number, shape (n,); −1 where there is no such part."""
    direction: NodeVector
    """Unit vector along that part, shape (n, d); zero where there is none."""
    length: NodeScalar
    """Length of that part [-], shape (n,); 1 where there is none."""
    speed: NodeScalar
    """Velocity along it [m/s], shape (n,), at which the whole normal velocity is that of the collider."""


class Nodes(AbstractNodes):
    """The nodes at the start of a step, with the step and the boundaries: the input of an integrator."""

    mass: NodeScalar
    """m_i [kg], shape (n,), folded at symmetry planes; zero on empty nodes (see `p2g`)."""
    sums: SeparateSums | JoinedSum
    """The sums of P2G besides the mass."""
    dt: Float[Array, ""]
    """Δt [s]."""
    spacing: Float[Array, ""]
    """dx [m]."""
    potential: ElasticPotential
    """Φ, a function of nodal displacements."""
    conditions: Conditions
    """The conditions that the boundaries prescribe."""
    contacts: tuple[AbstractContact, ...] = ()
    """The contacts of the scene; none of them is active here."""
    brought_by: tuple[int | None, ...] = eqx.field(static=True, default=())
    """The number of the boundary that brings each contact; None for that of two bodies."""
    mirror_motion: MirrorMotion | None = None
    """What mirrors that move add to the velocity of the nodes beyond them; None if none moves."""
    loose: "Nodes | None" = None
    """The same nodes with those of rigid bodies each by itself; None without rigid bodies."""

    @property
    def occupied(self) -> Bool[Array, "n 1"]:
        """Whether a node has mass, shape (n, 1)."""
        return (self.mass > 0)[:, None]

    @property
    def velocity(self) -> NodeVector:
        """v_i^n [m/s], shape (n, d); zero on empty nodes.

        Raises:
            ValueError: P2G summed momentum and force together.
        """
        return self.sums.velocity

    @property
    def force(self) -> NodeVector:
        """The internal force at the start of the step [N], shape (n, d).

        Raises:
            ValueError: P2G summed momentum and force together.
        """
        return self.sums.force

    @property
    def acceleration(self) -> Array:
        """Body acceleration g [m/s²], shape (d,), or (n, d) where it varies.

        Raises:
            ValueError: P2G summed momentum and force together.
        """
        return self.sums.acceleration

    @property
    def viscous_force(self) -> NodeVector | None:
        """The viscous part of `force` [N], shape (n, d); None unless it was asked for."""
        return self.sums.viscous_force

    @property
    def separate(self) -> bool:
        """Whether v^n and the force are known separately."""
        return self.sums.separate

    @property
    def free(self) -> Mask:
        """Whether a component is not prescribed, and its node has mass, shape (n, d)."""
        return self.occupied & ~self.conditions.fixed

    @property
    def mirror(self) -> Mirror:
        """The mirror images of symmetry planes, and of the active columns of contact planes."""
        return self.potential.mirror

    @property
    def free_normals(self) -> tuple[FreeNormal, ...]:
        """The parts of the colliders' normals in free components, made orthogonal in the colliders' order, as many as a
        node can have.

        With components a prescribed, n·v = n·v_c becomes Σ_free n v = n·v_c − Σ_a n_a v_a, and so for earlier parts.
        """
        colliders, found = self.conditions.colliders, []
        for slide in () if colliders is None else colliders.slides:
            part = jnp.where(self.free, slide.normal, 0)
            missing = slide.normal * (slide.velocity - jnp.where(self.free, 0, self.conditions.velocity))
            missing = missing.sum(axis=1)
            for other in found:
                share = (part * other.direction).sum(axis=1)
                part, missing = part - share[:, None] * other.direction, missing - share * other.speed
            square = (part**2).sum(axis=1)
            some = square > PARALLEL**2
            length = jnp.sqrt(jnp.where(some, square, 1))
            new = FreeNormal(
                normal=slide.normal,
                owner=jnp.where(some, jnp.int32(slide.number), -1),
                direction=jnp.where(some[:, None], part / length[:, None], 0),
                length=length,
                speed=jnp.where(some, missing / length, 0),
            )
            for place, old in enumerate(found):  # goes into the first place that is empty at each node
                taken = old.owner >= 0
                found[place] = _where(taken, old, new)
                new = _where(taken, new, jax.tree.map(jnp.zeros_like, new))
                new = replace(new, owner=jnp.where(taken, new.owner, -1), length=jnp.where(taken, new.length, 1))
            if len(found) < self.conditions.fixed.shape[1]:
                found.append(new)
        return tuple(found)

    @property
    def projection(self) -> Projection:
        """The projection on the components of velocity that nothing holds."""
        return Projection(self.free, tuple(part.direction for part in self.free_normals))

    @property
    def moves_held(self) -> bool:
        """Whether held components may have another velocity than zero."""
        return self.conditions.moves or self.mirror_motion is not None

    @property
    def prescribed(self) -> NodeVector:
        """The velocity of held components [m/s], shape (n, d)."""
        parts, velocity = self.free_normals, self.conditions.velocity
        if self.mirror_motion is not None:
            velocity = jnp.where(self.mirror_motion.beyond, self.mirror_motion.velocity, velocity)
        if not parts:
            return velocity
        along = reduce(jnp.add, (part.direction * part.speed[:, None] for part in parts))
        return jnp.where(self.free, along, velocity)

    def explicit_velocity(self) -> NodeVector:
        """v* = v^n + Δt f/m + Δt g [m/s], shape (n, d) (derivation, eq. 4)."""
        return self.sums.explicit_velocity(self.mass, self.dt)

    def inertial_velocity(self) -> NodeVector:
        """v^n + Δt g [m/s], shape (n, d)."""
        return self.sums.inertial_velocity(self.mass, self.dt)

    def admitted(self, velocity: NodeVector) -> NodeVector:
        """A velocity that is zero on empty nodes, with the prescribed values in held components [m/s], shape (n, d)."""
        return self.projection.combine(velocity, self.prescribed) if self.conditions.holds else velocity

    def admitted_velocity(self) -> NodeVector:
        """v^n with the prescribed values in held components [m/s], shape (n, d)."""
        return self.admitted(self.velocity)

    def per_mass(self, impulse: NodeVector) -> NodeVector:
        """An impulse or force divided by the nodes' mass; zero on empty nodes."""
        return per_mass(impulse, self.mass)

    def folded(self, images: Mirror) -> "Nodes":
        """The nodes with the sums of their images at mirror planes added; the same nodes without a plane.

        A force is folded as the momentum that it makes is.
        """
        if not images.images:
            return self
        folded = images.fold_scalar(self.mass), images.then(self.potential.mirror)
        nodes = eqx.tree_at(lambda n: (n.mass, n.potential.mirror), self, folded)

        def fold_per_mass(v: Array) -> NodeVector:
            return nodes.per_mass(images.fold(self.mass[:, None] * v))

        return replace(nodes, sums=self.sums.folded(fold_per_mass, images.fold))

    def tied(self, rigid: RigidLayers) -> "Nodes":
        """The nodes with those of rigid bodies folded to the two that move each of them."""
        nodes = self.folded(Mirror(rigid.images))
        new = jnp.where(rigid.own, rigid.velocity, nodes.velocity), rigid.conditions, self
        return eqx.tree_at(attrgetter("sums.velocity", "conditions", "loose"), nodes, new, is_leaf=lambda x: x is None)

    def moved_by(self, change: NodeVector) -> "Nodes":
        """The nodes with a velocity [m/s], shape (n, d), added to theirs."""
        return replace(self, sums=self.sums.moved_by(jnp.where(self.occupied, change, 0)))

    def constrained(
        self,
        images: Mirror,
        fixed: Mask,
        springs: tuple[Springs, ...],
        couplings: tuple[Coupling, ...],
    ) -> "Nodes":
        """The nodes folded at these mirrors, with the components `fixed` held, and the force of the springs and
        couplings."""
        nodes = replace(self.folded(images), conditions=replace(self.conditions, fixed=fixed, holds=True))
        if springs or couplings:
            nodes = eqx.tree_at(lambda n: (n.potential.springs, n.potential.couplings), nodes, (springs, couplings))
            nodes = replace(nodes, sums=nodes.sums.with_force(nodes.potential.spring_force(None), nodes.mass, self.dt))
        return nodes


def _where(mask: Bool[Array, "n"], a: FreeNormal, b: FreeNormal) -> FreeNormal:
    return jax.tree.map(lambda x, y: jnp.where(mask if x.ndim == 1 else mask[:, None], x, y), a, b)


def particles_to_grid(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    stencil: Stencil,
    *,
    body_force_at: float = 0.0,
    force_at: Scalar | None = None,
    explicit_viscosity: bool = False,
    joined: bool = False,
    viscosity_apart: bool = False,
    folded: bool = True,
) -> Nodes:
    """P2G, folded at symmetry planes, with the elastic potential and the boundaries of the step from t to t + dt.

    Args:
        scene: the scene.
        particles: prepared particles.
        t: time at the start of the step [s].
        dt: step [s].
        stencil: stencil of the particles.
        body_force_at: the time at which body forces are evaluated, as a fraction of the step. Positions are moved on to
            it with the particles' velocity.
        force_at: the share of the step's displacement at which forces are evaluated; None if the step is explicit.
        explicit_viscosity: whether the force includes the viscous stress, at the particles' stored velocity gradients.
        joined: whether momentum and force may be summed together. They are if both have the same gradient operator.
        viscosity_apart: whether to compute the viscous part of the force separately too.
        folded: whether to fold at symmetry planes.
    """
    grid, window = scene.grid, scene.window(particles)
    v = components(particles.v)
    C = None if particles.C is None else components(particles.C)
    affine = C if scene.transfer.affine else None
    with jax.named_scope("p2g"):
        points = points_of(scene.loads, scene.laws, particles, stencil, total=scene.total)
        supports = supports_of(scene.loads, points, t + body_force_at * dt)
        potential = ElasticPotential(scene.material_points(particles, t), stencil, Mirror(()), grid.size, supports)
        joined = joined and stencil.mls_weight_derivatives is None and not scene.rigid_bodies
        flux, viscous_flux = potential.current_flux(), None
        if explicit_viscosity and potential.material_viscous and C is not None:
            viscous_flux = potential.viscous_flux(C)
            flux = flux + viscous_flux
        pushed = _body_force(scene, particles, t, dt, body_force_at)
        if joined:
            g = jnp.asarray(scene.gravity)[:, None]
            v = v + dt * (g if pushed is None else g + pushed)
        mass, velocity = p2g(stencil, particles.mass, v, affine, grid.size, -dt * flux if joined else None)
        loaded = load_force(scene.loads, points, t, dt, body_force_at, grid.size)
        held = potential.support_force() if supports else None
        drag = potential.support_drag() if explicit_viscosity else None
        if joined:
            at_nodes = [force for force in (loaded, held, drag) if force is not None]
            sums = JoinedSum(velocity + dt * per_mass(reduce(jnp.add, at_nodes), mass) if at_nodes else velocity)
        else:
            acceleration = jnp.asarray(scene.gravity)
            if loaded is not None:
                acceleration = acceleration + per_mass(loaded, mass)
            if pushed is not None:
                acceleration = acceleration + per_mass(scatter(stencil, particles.mass * pushed, None, grid.size), mass)
            force, viscous_force = -potential.nodal_sum(flux), None
            if viscosity_apart and viscous_flux is not None:
                viscous_force = -potential.nodal_sum(viscous_flux)
            if held is not None:
                force = force + held
            if drag is not None:
                force = force + drag
            if viscosity_apart and drag is not None:
                viscous_force = drag if viscous_force is None else viscous_force + drag
            sums = SeparateSums(velocity, force, viscous_force, acceleration)
        places = scene.nodes(particles, t)
        conditions = combined_conditions(scene.boundary, places, grid.spacing, t, dt, reference=scene.total)
        if scene.total and conditions.colliders is not None and conditions.colliders.slides:
            slid = reduce(jnp.logical_or, (slide.normal.any(axis=1) for slide in conditions.colliders.slides))
            place = jnp.where(
                (slid & (mass > 0))[:, None], places_of(particles, stencil, grid.size), conditions.colliders.position
            )
            conditions = eqx.tree_at(lambda c: c.colliders.position, conditions, place)
        faces = faces_of(scene, particles, potential.material_points, stencil, dt, force_at)
        acts_at = t if force_at is None else t + jnp.where(jnp.asarray(force_at) > 0, dt, 0)
        brought: list[tuple[int | None, AbstractContact]] = [
            *brought_contacts(scene.boundary, conditions, grid, window, t, dt, faces, acts_at)
        ]
        images = mirror(scene.boundary, grid, window)
        touching = contacts_of_bodies(scene, particles, potential.material_points, stencil, images, dt, force_at)
        brought += [(None, contact) for contact in touching]
        nodes = Nodes(
            mass=mass,
            sums=sums,
            dt=jnp.asarray(dt),
            spacing=jnp.asarray(grid.spacing),
            potential=potential,
            conditions=conditions,
            contacts=tuple(contact for _, contact in brought),
            brought_by=tuple(number for number, _ in brought),
            mirror_motion=mirror_motion(scene.boundary, grid, window, t, dt),
        )
        return folded_at_planes(scene, particles, nodes) if folded else nodes


def folded_at_planes(scene: Scene, particles: Particles, nodes: Nodes) -> Nodes:
    """The nodes, folded at the scene's symmetry planes, and those of rigid bodies to the two that move each."""
    images, moving = mirror(scene.boundary, scene.grid, scene.window(particles)), nodes.mirror_motion
    with jax.named_scope("p2g"):
        if scene.rigid_bodies:
            rigid = rigid_layers(scene, particles, nodes.mass, nodes.conditions, images, nodes.dt)
            return nodes.folded(images).tied(rigid)
        if moving is None:
            return nodes.folded(images)
        # at rest with the mirrors: the velocity less what they add, which is put back
        added = jnp.where(nodes.conditions.fixed, nodes.conditions.velocity, 0)
        added = jnp.where(moving.beyond, moving.velocity, added)
        added = images.added(added)
        return nodes.moved_by(-images.unfold(added)).folded(images).moved_by(added)


def _body_force(scene: Scene, particles: Particles, t: Scalar, dt: Scalar, part: float) -> Float[Array, "d p"] | None:
    """The scene's body force per unit mass [m/s²], at a part of the step, to which positions are moved on with the
    particles' velocity; None without one."""
    if scene.body_force is None:
        return None
    if part > 0:
        return components(scene.body_force.acceleration(particles.x + part * dt * particles.v, t + part * dt))
    return components(scene.body_force.acceleration(particles.x, t))


def places_of(particles: Particles, stencil: Stencil, size: int) -> NodeVector:
    """Current positions of reference nodes, Σ_p w_ip m_p (x_p + F_p (X_i − X_p)) / m_i [m], shape (n, d); zero on empty
    nodes."""
    F = jnp.concatenate([group.deformation() for group in particles.groups], axis=-1)
    return p2g(stencil, particles.mass, components(particles.x), F, size)[1]
