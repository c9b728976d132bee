"""The grid's side of a step: what the particles bring to the nodes, and what the nodes' new velocity is made from."""

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Mask, NodeScalar, NodeVector, Scalar, components
from mpmjax.boundary import AbstractContact, AbstractNodes, Conditions, Mirror, combine, contacts_of, mirror
from mpmjax.discretisation import Stencil, p2g, scatter
from mpmjax.implicit import ElasticPotential, Projection
from mpmjax.state import Particles, Scene

_PARALLEL = 1e-2  # a normal whose part in free components is smaller is prescribed by the others


class FreeNormal(eqx.Module):
    """The part of the colliders' normals in the components that nothing prescribes."""

    direction: NodeVector
    """The unit vector along it, shape (n, d); zero where there is none."""
    length: NodeScalar
    """Its length [-], shape (n,); 1 where there is none."""
    speed: NodeScalar
    """The velocity along it [m/s] with which the whole normal component is the collider's, shape (n,)."""


class Nodes(AbstractNodes):
    """What the velocity update of one step is given."""

    mass: NodeScalar
    """m_i [kg], shape (n,), folded at symmetry planes; zero on empty nodes, whose mass is but rounding."""
    velocity: NodeVector
    """v_i^n [m/s], shape (n, d); zero on empty nodes. Plus Δt f_i/m_i where P2G has added the force's impulse."""
    occupied: Bool[Array, "n 1"]
    """Whether the node has mass beyond rounding, that of the lightest particle, shape (n, 1)."""
    acceleration: Array
    """Body acceleration g [m/s²], shape (d,), or (n, d) where it varies."""
    force: NodeVector
    """f_i at the start of the step [N], shape (n, d); zero where P2G has added its impulse to the momentum."""
    dt: Float[Array, ""]
    """Δt [s]."""
    spacing: Float[Array, ""]
    """dx [m]."""
    potential: ElasticPotential
    """Φ, of nodal displacements."""
    conditions: Conditions
    """What the boundaries prescribe."""
    viscous: NodeVector | None = None
    """The part of viscosity in an explicit step's force [N], shape (n, d), where it was wanted apart."""
    contacts: tuple[AbstractContact, ...] = ()
    """The boundaries that may be left, of which none holds anything here."""

    @property
    def free(self) -> Mask:
        """The components that nothing prescribes, on nodes that have mass."""
        return self.occupied & ~self.conditions.fixed

    @property
    def mirror(self) -> Mirror:
        """The mirror images of symmetry planes, and of the columns of contact planes that are held."""
        return self.potential.mirror

    @property
    def free_normal(self) -> FreeNormal | None:
        """The colliders' normals, held or not, as far as they ask for more than the prescribed components give; None
        without colliders.

        With components a prescribed, n·v = n·v_c says Σ_free n v = n·v_c − Σ_a n_a v_a.
        """
        colliders = self.conditions.colliders
        if colliders is None:
            return None
        part = jnp.where(self.free, colliders.normal, 0)
        square = (part**2).sum(axis=1)
        some = square > _PARALLEL**2
        length = jnp.sqrt(jnp.where(some, square, 1))
        asked = colliders.normal * (colliders.velocity - jnp.where(self.free, 0, self.conditions.velocity))
        return FreeNormal(
            direction=jnp.where(some[:, None], part / length[:, None], 0),
            length=length,
            speed=jnp.where(some, asked.sum(axis=1) / length, 0),
        )

    @property
    def projection(self) -> Projection:
        """The projection on what nothing holds."""
        colliders, part = self.conditions.colliders, self.free_normal
        if colliders is None or part is None:
            return Projection(self.free)
        return Projection(self.free, jnp.where(colliders.held[:, None], part.direction, 0))

    @property
    def prescribed(self) -> NodeVector:
        """The velocity [m/s], shape (n, d), of what is held."""
        part = self.free_normal
        if part is None:
            return self.conditions.velocity
        return jnp.where(self.free, part.direction * part.speed[:, None], self.conditions.velocity)

    def explicit_velocity(self) -> NodeVector:
        """v* = v^n + Δt f / m + Δt g (derivation, eq. 4)."""
        force = self.force if self.viscous is None else self.force + self.viscous
        return jnp.where(self.occupied, self.inertial_velocity() + self.dt * self.per_mass(force), 0)

    def inertial_velocity(self) -> NodeVector:
        """ṽ = v^n + Δt g."""
        return jnp.where(self.occupied, self.velocity + self.dt * self.acceleration, 0)

    def admitted_velocity(self) -> NodeVector:
        """v^n with what is prescribed: what a wall will hold stops as the step begins."""
        return self.projection.combine(self.velocity, self.prescribed)

    def per_mass(self, impulse: NodeVector) -> NodeVector:
        """An impulse or force over the nodes' mass; zero on empty nodes."""
        return jnp.where(self.occupied, impulse / jnp.where(self.occupied, self.mass[:, None], 1), 0)

    def folded(self, images: Mirror) -> "Nodes":
        """The true nodes of mirror planes, with what their images received. Nothing changes without a plane.

        A force is folded like the momentum it makes: a plane's mirror image is pulled the other way.
        """
        if not images.images:
            return self
        mass = images.fold_scalar(self.mass)
        momentum, pull = self.mass[:, None] * self.velocity, self.mass[:, None] * self.acceleration
        nodes = eqx.tree_at(
            lambda n: (n.mass, n.occupied, n.force, n.potential.mirror),
            self,
            (mass, (mass > 0)[:, None], images.fold(self.force), images.then(self.potential.mirror)),
        )
        parts = nodes.per_mass(images.fold(momentum)), nodes.per_mass(images.fold(pull))
        nodes = eqx.tree_at(lambda n: (n.velocity, n.acceleration), nodes, parts)
        return nodes if nodes.viscous is None else eqx.tree_at(lambda n: n.viscous, nodes, images.fold(nodes.viscous))

    def constrained(self, images: Mirror, fixed: Mask, normals: Bool[Array, "n"] | None) -> "Nodes":
        """These nodes folded on the mirrors, with the components `fixed` and the `normals` held too."""
        nodes, colliders = (
            eqx.tree_at(lambda n: n.conditions.fixed, self.folded(images), fixed),
            self.conditions.colliders,
        )
        if normals is None or colliders is None:
            return nodes
        return eqx.tree_at(lambda n: n.conditions.colliders.held, nodes, colliders.held | normals)


def particles_to_grid(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    stencil: Stencil,
    *,
    centred: bool,
    lagged: bool = False,
    kicked: bool = False,
    apart: bool = False,
) -> Nodes:
    """P2G, folded at symmetry planes, with the elastic potential and the boundaries of the step from t to t + dt.

    Body forces are those of the particles at t, or with `centred` at t + ½dt, half a step on by their velocity. With
    `kicked` the elastic force is not wanted for itself: its impulse over the step goes to the nodes in one sum with the
    momentum, where they have one gradient operator, and half of P2G's cost is saved. With `lagged` the viscous stress
    of the particles' own velocity gradients is part of that force, or with `apart` beside it.
    """
    grid, window = scene.grid, scene.window(particles)
    v = components(particles.v)
    C = None if particles.C is None else components(particles.C)
    affine = C if scene.transfer.affine else None
    acceleration = jnp.asarray(scene.gravity)
    with jax.named_scope("p2g"):
        potential = ElasticPotential(scene.material_points(particles), stencil, Mirror(()))
        kicked = kicked and stencil.affine_slopes is None
        resisted = C if lagged and potential.viscous else None
        flux = potential.current_flux()
        if resisted is not None and not apart:
            flux = flux + potential.viscous_flux(resisted)
        mass, momentum = p2g(stencil, particles.mass, v, affine, grid.size, -dt * flux if kicked else None)
        lightest = particles.mass.min()  # a mean would empty the nodes of a body much lighter than the others
        occupied = (mass > jnp.finfo(mass.dtype).eps * lightest)[:, None]
        full = jnp.where(occupied, mass[:, None], 1)
        if scene.body_force is not None:
            x, at = (particles.x + dt / 2 * particles.v, t + dt / 2) if centred else (particles.x, t)
            push = particles.mass * components(scene.body_force.acceleration(x, at))
            force = scatter(stencil, push, None, grid.size)
            acceleration = acceleration + jnp.where(occupied, force / full, 0)
        conditions = combine(scene.boundary, grid.nodes(window), grid.spacing, t, dt, reference=scene.total)
        if scene.total and conditions.colliders is not None and scene.slides:
            slid = (conditions.colliders.owner >= 0)[:, None] & occupied
            place = jnp.where(slid, _place(particles, stencil, grid.size) / full, conditions.colliders.position)
            conditions = eqx.tree_at(lambda c: c.colliders.position, conditions, place)
        nodes = Nodes(
            mass=jnp.where(occupied[:, 0], mass, 0),
            velocity=jnp.where(occupied, momentum / full, 0),
            occupied=occupied,
            acceleration=acceleration,
            force=jnp.zeros_like(momentum) if kicked else -potential.sum_of(flux, momentum),
            dt=jnp.asarray(dt),
            spacing=jnp.asarray(grid.spacing),
            potential=potential,
            conditions=conditions,
            viscous=None
            if resisted is None or not apart
            else -potential.sum_of(potential.viscous_flux(resisted), momentum),
            contacts=contacts_of(scene.boundary, conditions, grid, window),
        )
        return nodes.folded(mirror(scene.boundary, grid, window))


def _place(particles: Particles, stencil: Stencil, size: int) -> NodeVector:
    """The places of reference nodes times their mass, Σ_p w_ip m_p (x_p + F_p (X_i − X_p)) [kg m], shape (n, d)."""
    F = jnp.concatenate([components(group) for group in jax.tree.leaves(particles.F)], axis=-1)
    return p2g(stencil, particles.mass, components(particles.x), F, size)[1]
