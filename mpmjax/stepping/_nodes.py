"""The nodes at the start of a step: P2G, then boundaries and contacts, then the fold at mirror planes."""

from dataclasses import replace
from functools import reduce
from typing import Any, NoReturn

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Mask, NodeScalar, NodeVector, Scalar, components
from mpmjax.boundary import AbstractContact, Conditions, FreeNormal, combined_conditions, mirror, with_tied_columns
from mpmjax.discretisation import Stencil, in_section, in_space, p2g, scatter
from mpmjax.implicit import ElasticPotential, Projection
from mpmjax.potential import AbstractTerm, Forces, Mirror, SurfaceImage, WallImage
from mpmjax.state import AbstractLayerImage, Particles, Scene, load_force, points_of, terms_of
from mpmjax.stepping._contact_surfaces import contacts_of_bodies, faces_of


class Nodes(eqx.Module):
    """The nodes at the start of a step, with the step and the boundaries: the input of an integrator."""

    mass: NodeScalar  # m_i [kg], shape (n,), folded at symmetry planes; zero on empty nodes (see `p2g`)
    v: NodeVector  # `velocity`; where P2G has summed momentum and force together, v*
    f: NodeVector | None  # `force`; None where P2G has summed momentum and force together
    g: Any  # `acceleration`, an array; None likewise
    dt: Float[Array, ""]  # Δt [s]
    spacing: Float[Array, ""]  # dx [m]
    potential: ElasticPotential  # Φ, a function of nodal displacements
    conditions: Conditions  # the conditions that the boundaries prescribe
    contacts: tuple[AbstractContact, ...] = ()  # the contacts of the scene; none of them is active here
    walls: tuple[tuple[WallImage | SurfaceImage, ...], ...] = ()  # the walls of each boundary that are never left
    brought_by: tuple[int | None, ...] = eqx.field(static=True, default=())
    """The number of the boundary that brings each contact; None for that of two bodies."""
    loose: "Nodes | None" = None  # the nodes before the constraints of bodies; None without any
    tied: tuple[AbstractLayerImage, ...] = ()  # the maps of these constraints
    inner: Any = None  # the contacts in an inner stage, a `StageContact`; None without contacts

    @property
    def occupied(self) -> Bool[Array, "n 1"]:
        """Whether a node has mass, shape (n, 1)."""
        return (self.mass > 0)[:, None]

    @property
    def velocity(self) -> NodeVector:
        """Velocity at the start of the step v_i^n [m/s], shape (n, d); zero on empty nodes.

        Raises:
            ValueError: P2G summed momentum and force together. So for `force` and `acceleration`.
        """
        return self.v if self.f is not None else self._refuse()

    @property
    def force(self) -> NodeVector:
        """Internal force at the start of the step [N], shape (n, d), with that of explicit viscosity."""
        return self.f if self.f is not None else self._refuse()

    @property
    def acceleration(self) -> Array:
        """Body acceleration g [m/s²], shape (d,) or (n, d)."""
        return self.g if self.f is not None else self._refuse()

    def _refuse(self) -> NoReturn:
        raise ValueError(
            "P2G summed momentum and forces in one, so v^n, g and the force are not known apart: only "
            "nodes.explicit_velocity() is. An integrator that uses them must have needs_separate_force = True."
        )

    @property
    def free(self) -> Mask:
        """Whether a component is not prescribed, and its node has mass, shape (n, d)."""
        return self.occupied & ~self.conditions.fixed

    @property
    def free_normals(self) -> tuple[FreeNormal, ...]:
        """The free parts of the colliders' normals (see `Conditions.free_normals`)."""
        return self.conditions.free_normals(self.free)

    @property
    def projection(self) -> Projection:
        """The projection on the components of velocity that nothing holds."""
        if not self.conditions.slides:
            return Projection(self.free)
        return Projection(self.free, tuple(part.direction for part in self.free_normals))

    @property
    def prescribed(self) -> NodeVector:
        """The velocity of held components [m/s], shape (n, d)."""
        velocity, images = self.conditions.velocity, self.potential.mirror
        velocity = images.with_motion(velocity) if images.images else velocity
        if not self.conditions.slides:
            return velocity
        along = reduce(jnp.add, (part.direction * part.speed[:, None] for part in self.free_normals))
        return jnp.where(self.free, along, velocity)

    def inertial_velocity(self) -> NodeVector:
        """v^n + Δt g [m/s], shape (n, d)."""
        return jnp.where(self.occupied, self.velocity + self.dt * self.g, 0)

    def explicit_velocity(self) -> NodeVector:
        """v* = v^n + Δt f/m + Δt g [m/s], shape (n, d) (derivation, eq. 4)."""
        return self.v if self.f is None else self.inertial_velocity() + self.dt * self.per_mass(self.f)

    def admitted_velocity(self) -> NodeVector:
        """v^n with the prescribed values in held components [m/s], shape (n, d)."""
        return self.projection.combine(self.velocity, self.prescribed) if self.conditions.holds else self.velocity

    def per_mass(self, impulse: NodeVector) -> NodeVector:
        """An impulse or force divided by the nodes' mass; zero on empty nodes."""
        return jnp.where(self.occupied, impulse / jnp.where(self.occupied, self.mass[:, None], 1), 0)

    def pushed(self, force: NodeVector) -> "Nodes":
        """The nodes with a further internal force [N], shape (n, d)."""
        if self.f is None:
            return replace(self, v=self.v + self.dt * self.per_mass(force))
        return replace(self, f=self.f + force)

    def accelerated(self, force: NodeVector) -> "Nodes":
        """The nodes with a further outer force [N], shape (n, d)."""
        if self.g is None:
            return self.pushed(force)
        return replace(self, g=self.g + self.per_mass(force))

    def folded(self, images: Mirror, mass: NodeScalar | None = None) -> "Nodes":
        """The nodes with the sums of their images at mirror planes added. A force is folded as the momentum that it
        makes is; the folded mass may be known already."""
        mass = images.fold_scalar(self.mass) if mass is None else mass
        folded, v, put_back = replace(self, mass=mass), self.v, None
        if images.moving:  # at rest with the mirrors: the velocity less what they add, which is put back
            put_back = images.with_motion(jnp.where(self.conditions.fixed, self.conditions.velocity, 0))
            put_back = images.with_leaders(images.added(put_back), self.v)
            v = v - jnp.where(self.occupied, images.unfold(put_back), 0)
            put_back = jnp.where(folded.occupied, put_back, 0)
            folded = replace(folded, conditions=replace(self.conditions, moves=True))

        def fold(field: Array) -> NodeVector:
            """Fold a field per mass."""
            return folded.per_mass(images.fold(self.mass[:, None] * field))

        return replace(
            folded,
            v=fold(v) if put_back is None else fold(v) + put_back,
            f=None if self.f is None else images.fold(self.f),
            g=None if self.g is None else fold(self.g),
            potential=replace(self.potential, mirror=Mirror(images.images + self.potential.mirror.images)),
        )

    def constrained(self, images: Mirror, mass: NodeScalar, fixed: Mask, terms: tuple[AbstractTerm, ...]) -> "Nodes":
        """The nodes folded at these mirrors to these masses, with the components `fixed` held, and the force of further
        terms."""
        nodes = self.folded(images, mass) if images.images else self
        for wall in images.moving if images.images else ():
            fixed = fixed | wall.carried(fixed.shape[1])
        nodes = replace(nodes, conditions=replace(nodes.conditions, fixed=fixed, holds=True))
        if not terms:
            return nodes
        potential = replace(nodes.potential, terms=nodes.potential.terms + terms)
        force = potential.on_nodes([term.force(potential.displaced(None)) for term in terms])
        return replace(nodes, potential=potential).pushed(force)


def particles_to_grid(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    stencil: Stencil,
    *,
    body_force_at: float = 0.0,
    explicit_viscosity: bool = False,
    joined: bool = False,
) -> Nodes:
    """P2G: mass, velocity and force of the nodes in the step from t to t + dt, and the elastic potential.

    Args:
        body_force_at: the time at which body forces are evaluated, as a fraction of the step. Positions are moved on to
            it with the particles' velocity.
        explicit_viscosity: whether the force includes the viscous stress, at the particles' stored velocity gradients.
        joined: whether momentum and force may be summed together. They are if both have the same gradient operator.
    """
    size, v = scene.grid.size, components(particles.v)
    C = None if particles.C is None else components(particles.C)
    joined = joined and (stencil.is_least_squares or not scene.transfer.affine)
    potential = ElasticPotential(scene.material_points(particles, t), stencil, Mirror(()), size)
    L = C if explicit_viscosity and potential.material_viscous else None
    # of the flux V P Fᵀ, of which the internal force is −Σ_p flux_p g_ip
    A, B = potential.stress_factors() if joined and L is None else (potential.weighted_stress(), None)
    if L is not None:
        L = L if stencil.radius is None else in_space(stencil.radius, v, L)
        A = A + potential.weighted_viscous_stress(L)
    gravity, body_force = jnp.asarray(scene.gravity), None
    if scene.body_force is not None:
        x = particles.x + body_force_at * dt * particles.v if body_force_at else particles.x
        body_force = components(scene.body_force.acceleration(x, t + body_force_at * dt if body_force_at else t))
    # one sum costs half of two, and an explicit step asks for v* alone
    if joined and body_force is not None:
        v = v + dt * body_force
    if stencil.radius is not None and joined:
        around, A = in_section(stencil.radius, A)
        v = v - dt * around / particles.mass
    affine, impulse = C if scene.transfer.affine else None, (jnp.asarray(-dt), A, B) if joined else None
    mass, v = p2g(stencil, particles.mass, v, affine, size, impulse, dt * gravity if joined else None)
    nodes = Nodes(
        mass=mass,
        v=v,
        f=None if joined else potential.on_nodes([Forces(slopes=-la.transpose(A))]),
        g=None if joined else gravity,
        dt=jnp.asarray(dt),
        spacing=jnp.asarray(scene.grid.spacing),
        potential=potential,
        conditions=Conditions(jnp.zeros(v.shape, bool), jnp.zeros_like(v), holds=False, moves=False),
    )
    if scene.loads:  # forces at points of the body, and the terms of springs and dashpots
        points = points_of(scene.loads, scene.laws, particles, stencil, total=scene.total)
        potential = replace(potential, terms=terms_of(scene.loads, points, t + body_force_at * nodes.dt))
        forces = [term.force(potential.displaced(None)) for term in potential.terms]
        if explicit_viscosity:
            forces += [drag for drag, _ in potential.drags()]
        nodes = replace(nodes, potential=potential)
        force = load_force(scene.loads, points, t, nodes.dt, body_force_at, size)
        nodes = nodes if force is None else nodes.accelerated(force)
        nodes = nodes.pushed(potential.on_nodes(forces)) if forces else nodes
    if body_force is not None and not joined:
        nodes = nodes.accelerated(scatter(stencil, particles.mass * body_force, None, size))
    return nodes


def with_boundaries(
    scene: Scene, particles: Particles, nodes: Nodes, t: Scalar, force_at: Scalar | None = None
) -> Nodes:
    """The nodes of `particles_to_grid` with the conditions and contacts of boundaries and bodies in the step from t.
    Forces are evaluated at the share `force_at` of the step's displacement; None if the step is explicit."""
    grid, window, dt, potential = scene.grid, scene.window(particles), nodes.dt, nodes.potential
    places = scene.nodes(particles, t)
    conditions = combined_conditions(scene.boundary, places, grid.spacing, t, dt, reference=scene.total)
    faces, walls = None, ()
    flows = any(law.flows for law in scene.laws) and any(boundary.holds_fluids for boundary in scene.boundary)
    if flows or any(boundary.pushes or boundary.sees_faces for boundary in scene.boundary):
        faces = faces_of(scene, particles, potential, t, dt, force_at)
        walls = tuple(boundary.fluid_walls(faces, grid, window, t, dt) for boundary in scene.boundary) if flows else ()
    each = enumerate(scene.boundary)
    brought = [(n, contact) for n, boundary in each for contact in boundary.contacts(faces, grid, window, t, dt)]
    contacts, brought_by = [contact for _, contact in brought], [number for number, _ in brought]
    if scene.bodies is not None:
        images = mirror(scene.boundary, grid, window)
        contacts += contacts_of_bodies(scene, scene.bodies.friction, particles, potential, images, dt, force_at)
    numbers = (*brought_by, *[None] * (len(contacts) - len(brought_by)))
    nodes = replace(nodes, conditions=conditions, contacts=tuple(contacts), walls=walls, brought_by=numbers)
    return with_tied_columns(nodes) if walls else nodes


def folded_at_planes(scene: Scene, particles: Particles, nodes: Nodes, t: Scalar) -> Nodes:
    """The nodes, folded at the scene's symmetry planes, and those of constrained bodies to the few that move each."""
    images = mirror(scene.boundary, scene.grid, scene.window(particles), t, nodes.dt)
    bodies = [constraint.at_start(scene, particles, nodes, images) for constraint in scene.constraints]
    if bodies:
        # all bodies in one fold: each fold divides by the mass, which would round the velocity of the others again
        loose, tied = nodes.folded(images) if images.images else nodes, tuple(image for image, *_ in bodies)
        nodes = loose.folded(Mirror(tied))
        layers = nodes.velocity, nodes.conditions.fixed, nodes.conditions.velocity
        for image, *parts in bodies:
            layers = [image.with_own(field, layer) for field, layer in zip(layers, parts, strict=True)]
        v, fixed, prescribed = layers
        conditions = replace(nodes.conditions, fixed=fixed, velocity=prescribed, holds=True, moves=True)
        return replace(nodes, v=v, conditions=conditions, loose=loose, tied=tied)
    return nodes.folded(images) if images.images else nodes


def start_nodes(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    stencil: Stencil,
    *,
    body_force_at: float = 0.0,
    explicit_viscosity: bool = False,
    force_at: Scalar | None = None,
) -> Nodes:
    """The nodes of `particles_to_grid` with boundaries, folded at mirror planes: what an integrator is given."""
    nodes = particles_to_grid(
        scene, particles, t, dt, stencil, body_force_at=body_force_at, explicit_viscosity=explicit_viscosity
    )
    if scene.boundary or scene.bodies is not None or scene.constraints:
        nodes = folded_at_planes(scene, particles, with_boundaries(scene, particles, nodes, t, force_at), t)
    return nodes


def places_of(particles: Particles, stencil: Stencil, size: int) -> NodeVector:
    """Current positions of reference nodes, Σ_p w_ip m_p (x_p + F_p (X_i − X_p)) / m_i [m], shape (n, d); zero on empty
    nodes."""
    d = particles.dim
    F = jnp.concatenate([group.deformation()[:d, :d] for group in particles.groups], axis=-1)
    return p2g(stencil, particles.mass, components(particles.x), F, size)[1]
