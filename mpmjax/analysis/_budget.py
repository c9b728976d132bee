"""Mass, momentum and energy of a state, and their budgets by transfer, force and approximation in each step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Matrix, NodeVector, ParticleScalar, Scalar, components
from mpmjax.checks import canonical, checked, require, require_positive, require_whole
from mpmjax.discretisation import Gathered, Stencil, gather, in_space, scatter
from mpmjax.implicit import Projection
from mpmjax.potential import Forces
from mpmjax.state import Particles, Scene, prepare
from mpmjax.stepping import AbstractIntegrator, Explicit, grid_to_particles, reaction, start_nodes, update


class Energy(eqx.Module):
    """The energy of a state [J] (per metre of thickness in 2-D, per square metre of section in 1-D)."""

    kinetic: Float[Array, "*f"]
    """½ Σ m (‖v‖² + tr(C D Cᵀ)), with the affine part for APIC; of a rigid body ½ M ‖V‖² + ½ ω·Iω."""
    elastic: Float[Array, "*f"]  # Σ V0 Ψ(F), with the elastic law for the present history
    potential: Float[Array, "*f"]  # −Σ m g·x

    @property
    def total(self) -> Float[Array, "*f"]:
        """The sum of all three."""
        return self.kinetic + self.elastic + self.potential


@checked
def energy(scene: Scene, particles: Particles) -> Energy:
    """The energy of a scene's particles."""
    scene = canonical(scene, particles.x.dtype)
    return _energy(scene, prepare(scene, particles))


def energy_of(scene: Scene, particles: Particles) -> Energy:
    """The energy of prepared particles, without compilation."""
    speed2 = (particles.v**2).sum(axis=1)
    if scene.transfer.affine and particles.C is not None:
        speed2 = speed2 + (particles.C**2 * scene.stencil(particles).moment.T[:, None, :]).sum(axis=(1, 2))
    kinetic = particles.mass * speed2 / 2
    for constraint in scene.constraints:
        rows = particles.groups[constraint.number].rows
        fields = (particles.x, particles.v, particles.mass, particles.volume)
        kinetic = kinetic.at[rows].set(0).at[rows.start].set(constraint.kinetic_energy(*(a[rows] for a in fields)))
    gravity = jnp.asarray(scene.gravity, particles.x.dtype)
    return Energy(
        kinetic=kinetic.sum(),
        elastic=(particles.volume * energy_density(scene, particles)).sum(),
        potential=-(particles.mass[:, None] * particles.x * gravity).sum(),
    )


_energy = eqx.filter_jit(energy_of)


def energy_density(scene: Scene, particles: Particles) -> ParticleScalar:
    """Ψ of each prepared particle [J/m^d of undeformed volume], shape (p,)."""
    return jnp.concatenate([points.energy_density(points.deformation) for points in scene.material_points(particles)])


@checked
def momentum(particles: Particles) -> Float[Array, "d"]:
    """Linear momentum Σ m v [kg m/s], shape (d,)."""
    return (particles.mass[:, None] * particles.v).sum(axis=0)


def volume_ratio(particles: Particles) -> ParticleScalar:
    """J = det F of each prepared particle [-], for laws that yield det F_E, shape (p,)."""
    return jnp.concatenate([group.volume_ratio() for group in particles.groups])


def grid_mass(scene: Scene, particles: Particles) -> Float[Array, ""]:
    """The mass on the grid [kg]. It is that of the particles to rounding, unless some left the window."""
    scene = canonical(scene, particles.x.dtype)
    return scatter(scene.stencil(prepare(scene, particles)), particles.mass[None], None, scene.grid.size).sum()


@checked
def pieces(scene: Scene, particles: Particles) -> int:
    """The number of pieces of the material. Particles with a common node of non-zero weight are of one piece; those
    without mass are of none.

    Pieces exchange neither momentum nor stress. In the updated description a body that is stretched until its particles
    lie further apart than the kernel reaches falls apart, whatever its law: *numerical fracture*, of which more pieces
    at the end of a run are a sign. `TotalLagrangian` and more particles a cell prevent it.
    """
    from scipy import sparse  # here, since they take long to import
    from scipy.sparse import csgraph

    scene = canonical(scene, particles.x.dtype)
    stencil = scene.stencil(prepare(scene, particles))
    there = np.asarray(particles.mass) > 0
    touching = (np.asarray(stencil.weight) > 0) & there
    particle = np.broadcast_to(np.arange(particles.count), touching.shape)[touching]
    _, node = np.unique(np.asarray(stencil.index)[touching], return_inverse=True)
    size = particles.count + int(node.max(initial=-1)) + 1
    edges = (np.ones(node.size, bool), (particle, particles.count + node))
    parts = csgraph.connected_components(sparse.coo_array(edges, (size, size)), directed=False)[0]
    return parts - int((~there).sum())


class EnergyBudget(eqx.Module):
    """The budget of energy for each of f steps [J]:

    Δkinetic + Δelastic + Δpotential = boundary + friction + body_force + solver + time_integration + averaging
    − p2g − g2p − implicit − viscous − plastic.

    Below, v̄ = (v^n + v^{n+1})/2 at the nodes and u_ip = v_p + C_p (x_i − x_p). No term is the remainder of the others:
    if the budget closes to rounding, all of them are right.
    """

    kinetic: Float[Array, "*f"]  # change of the particles' kinetic energy, with that of their affine motion
    elastic: Float[Array, "*f"]
    """Change of Σ V0 Ψ(F), and of the energy of the loads' terms, such as springs to the ground, by the motion of the
    body; that by a ground that moves is left out."""
    potential: Float[Array, "*f"]  # change of −Σ m g·x, minus the work of gravity
    p2g: Float[Array, "*f"]  # loss from particles to grid, ½ Σ_ip w m ‖u_ip − v_i^n‖² ≥ 0
    g2p: Float[Array, "*f"]
    """Loss from grid to particles, ½ Σ_ip w m ‖v_i^{n+1} − u_ip^{n+1}‖² ≥ 0 with PIC and APIC. With other transfers u
    is the velocity from the grid, and the energy of the velocity that particles keep is subtracted. The energy of the
    affine motion is that at the new position, on which the moment D of the linear kernel depends."""
    implicit: Float[Array, "*f"]
    """Dissipation by the implicit elastic force, (Δt f^n − its impulse)·v̄, which is β Δt² v̄·H v^{n+1} for the
    semi-implicit step. In methods of second order `time_integration` cancels it up to third order in Δt."""
    boundary: Float[Array, "*f"]
    """Work of walls and grips, impulse·v̄. At a wall it is the kinetic energy of what stops there."""
    friction: Float[Array, "*f"]  # work of friction, ≤ 0
    body_force: Float[Array, "*f"]  # work of the scene's body force and loads
    viscous: Float[Array, "*f"]
    """Dissipation by viscosity and dashpots, Δt Σ V σ_v : D ≥ 0, at the velocity in the viscous force."""
    plastic: Float[Array, "*f"]
    """Dissipation by return maps, Σ V0 (Ψ(trial deformation) − Ψ(returned deformation)), with the change of Ψ by
    hardening. If a step strains by many times the yield strain, the energy that it stores before the return is in
    `time_integration`: read the two together."""
    averaging: Float[Array, "*f"]
    """Change of Σ V0 Ψ(F̄) where volumes are averaged, by the particles' new places on the grid at the same F. Zero in
    the total description, and without averages."""
    solver: Float[Array, "*f"]  # work of the residual of the solve
    time_integration: Float[Array, "*f"]
    """Error of the time step: the change of the energies minus the work of their forces at the start,
    [Φ(Δt v_c) − Φ(0) + Δt f^n·v̄] + Δt G·(v̄ − v_c), with v_c the velocity at which the nodes move and G their weight,
    plus the work of the viscous impulse on v̄ beyond its dissipation. It is of second order in Δt for each step, and of
    first order over a given time."""

    @property
    def change(self) -> Float[Array, "*f"]:
        """Change of the total energy."""
        return self.kinetic + self.elastic + self.potential

    @property
    def explained(self) -> Float[Array, "*f"]:
        """The sum of all terms on the right, equal to `change`."""
        gains = self.boundary + self.friction + self.body_force + self.solver + self.time_integration + self.averaging
        return gains - self.p2g - self.g2p - self.implicit - self.viscous - self.plastic


class MomentumBudget(eqx.Module):
    """The budget of linear momentum for each of f steps [kg m/s], shape (f, d):

    change = gravity + body_force + boundary + friction + elastic + viscous + transfer.

    The impulse of a symmetry plane is that of its mirror image, in `elastic` and `transfer`, which else vanish.
    """

    change: Float[Array, "*f d"]  # change of Σ m v
    gravity: Float[Array, "*f d"]  # impulse of gravity
    body_force: Float[Array, "*f d"]  # impulse of the scene's body force and loads
    boundary: Float[Array, "*f d"]  # impulse of walls and grips, and the residual of the solve
    friction: Float[Array, "*f d"]  # impulse of friction
    elastic: Float[Array, "*f d"]  # impulse of the elastic force, and of the loads' terms
    viscous: Float[Array, "*f d"]  # impulse of viscosity and dashpots
    transfer: Float[Array, "*f d"]  # change by the transfers

    @property
    def explained(self) -> Float[Array, "*f d"]:
        """The sum of all terms on the right, equal to `change`."""
        outer = self.gravity + self.body_force + self.boundary + self.friction
        return outer + self.elastic + self.viscous + self.transfer


class Budget(eqx.Module):
    """Budgets of energy and momentum for the steps of a run."""

    energy: EnergyBudget  # the energy of each step [J]
    momentum: MomentumBudget  # the momentum of each step [kg m/s]


@checked
def budget(
    scene: Scene,
    particles: Particles,
    *,
    steps: int,
    dt: Scalar,
    method: AbstractIntegrator = Explicit(),
    start: int = 0,
) -> tuple[Particles, Budget]:
    """Run a scene for some steps, with the budgets of energy and momentum for each.

    Args:
        scene, particles, method, start: as in `simulate`.
        steps: number of steps f.
        dt: step [s].

    Returns:
        the particles after the last step, and the budget, each of its terms with a leading axis f.

    Raises:
        ValueError: from `prepare`, a step that is not positive, a plane that mirrors and moves, a body under
            a constraint, such as a rigid one, or a correction.
    """
    require_positive("dt [s]", dt, particles.x.dtype)
    steps, start = require_whole("steps", steps, 1), require_whole("start", start, 0)
    constrained = [scene.laws[constraint.number].title() for constraint in scene.constraints]
    require(
        not constrained,
        f"A budget does not know how a {' or '.join(constrained)} body moves: ask for energy and momentum, or give the "
        "body a stiff law.",
    )
    require(
        not scene.moving_mirrors,
        "A budget does not know the work of a SymmetryPlane or ClampPlane that moves: take one at rest, in its own "
        "frame, a SlipCollider of a HalfSpace, or a Grip.",
    )
    require(scene.correction is None, "A budget does not know the work of a correction: take the scene without.")
    scene, dt, method = canonical((scene, dt, method), particles.x.dtype)
    return _budget(scene, prepare(scene, particles), jnp.asarray(start, particles.x.dtype), dt, method, steps)


@eqx.filter_jit
def _budget(
    scene: Scene, particles: Particles, start: Array, dt: Scalar, method: AbstractIntegrator, steps: int
) -> tuple[Particles, Budget]:
    def stepped(before: Particles, n: Array) -> tuple[Particles, Budget]:
        t = (start + n) * dt
        stencil = scene.stencil(before, t)
        nodes = start_nodes(
            scene,
            before,
            t,
            dt,
            stencil,
            body_force_at=method.body_force_at,
            force_at=method.force_at(),
            explicit_viscosity=method.explicit_viscosity,
        )
        new = update(nodes, method)
        trial = grid_to_particles(scene, before, nodes, new)
        after = scene.return_map(trial, dt)
        potential = nodes.potential
        stencil, images = potential.stencil, potential.mirror
        v0, v1 = nodes.velocity, new.motion.velocity
        all0, all1 = images.unfold(v0), images.unfold(v1)
        mean = (v0 + v1) / 2

        # impulses at the nodes
        friction = nodes.mass[:, None] * (v1 - new.solved.velocity)
        raw = scatter(stencil, before.mass[None], None, scene.grid.size)
        weight = dt * images.fold(raw * jnp.asarray(scene.gravity))
        body = jnp.where(nodes.occupied, dt * nodes.mass[:, None] * nodes.acceleration - weight, 0)
        reacted, free = reaction(nodes, new.solved, new.elastic), nodes.projection
        holding, held = reacted, new.constrained
        if held is not None:
            free, holding = Projection(*held.beyond_boundaries()), held.without_spring_impulses(reacted)
        missed = free.combine(holding, 0)
        boundary = reacted - missed

        # viscosity: its impulse, and what it dissipates of the velocity that it resists
        assert new.elastic is not None  # P2G was asked for momentum and force apart
        resisted, elastic, elastic_at_start = new.motion.resisted, new.elastic, dt * nodes.force
        viscous, dissipated = jnp.zeros_like(v0), jnp.zeros((), v0.dtype)
        if resisted is not None:
            viscous, dissipated = -dt * potential.viscous_resistance(resisted), dt * potential.power(resisted)
        elif method.explicit_viscosity and potential.viscous:  # part of the force
            drags = potential.drags()
            forces, dissipated = [force for force, _ in drags], sum((power for _, power in drags), dissipated)
            if potential.material_viscous and before.C is not None:
                C = components(before.C)
                C = C if stencil.radius is None else in_space(stencil.radius, components(before.v), C)
                stress = potential.weighted_viscous_stress(C)
                forces.append(Forces(slopes=-jnp.swapaxes(stress, 0, 1)))
                dissipated = dissipated + (stress * C).sum()
            if forces:
                force = potential.on_nodes(forces)
                viscous, dissipated = jnp.where(nodes.occupied, dt * force, 0), dt * dissipated
                elastic, elastic_at_start = elastic - viscous, elastic_at_start - dt * force

        # particle and nodes beside each other
        v_old = components(before.v)
        arrived = _gathered(scene, stencil, all1)
        gained = all1 - images.unfold(new.before(nodes)) if scene.transfer.needs_change else None
        change = None if gained is None else _gathered(scene, stencil, gained)
        moved = arrived.value
        C_old, C_new = (components(q.C) if scene.transfer.affine and q.C is not None else None for q in (before, after))
        beside = scene.transfer.velocity(v_old, arrived, change) - moved
        lost_p2g, gained_p2g = _mismatch(stencil, before.mass, v_old, C_old, all0)
        lost_g2p, _ = _mismatch(stencil, before.mass, moved, arrived.affine, all1)
        kept = (before.mass * beside * (moved + beside / 2)).sum()
        if C_new is not None and arrived.affine is not None:
            kept = kept + (before.mass * ((C_new**2 - arrived.affine**2) * stencil.moment).sum(axis=(0, 1))).sum() / 2
            if scene.kernel.order == 1:  # its moment D changes with the particle's place
                turn = scene.stencil(after).moment - stencil.moment
                kept = kept + (before.mass * (C_new**2 * turn).sum(axis=(0, 1))).sum() / 2

        averaging = jnp.zeros((), v0.dtype)  # by the averages at the particles' new positions
        if scene.volume is not None:
            pairs = zip(potential.material_points, scene.material_points(after), strict=True)
            changes = (n.volume * (n.energy_density(n.deformation) - o.energy_density(n.deformation)) for o, n in pairs)
            averaging = sum((change.sum() for change in changes), averaging)
        old, new_energy = energy_of(scene, before), energy_of(scene, after)
        moved_by = dt * new.motion.carrier
        stored = potential.energy(moved_by)
        in_terms = potential.term_energy(moved_by) - potential.term_energy(None)
        share = jnp.where(nodes.occupied, images.fold(jnp.broadcast_to(raw, v0.shape)), 0)
        share = nodes.per_mass(share)  # of an impulse at a node in the particles' momentum: 1 but at symmetry planes
        return after, Budget(
            EnergyBudget(
                kinetic=new_energy.kinetic - old.kinetic,
                elastic=new_energy.elastic - old.elastic + in_terms,
                potential=new_energy.potential - old.potential,
                p2g=lost_p2g,
                g2p=lost_g2p - kept,
                implicit=((elastic_at_start - elastic) * mean).sum(),
                boundary=(boundary * mean).sum(),
                friction=(friction * mean).sum(),
                body_force=(body * mean).sum(),
                viscous=dissipated,
                plastic=(before.volume * (energy_density(scene, trial) - energy_density(scene, after))).sum(),
                averaging=averaging,
                solver=(missed * mean).sum(),
                time_integration=stored
                - potential.energy(jnp.zeros_like(v0))
                + (elastic_at_start * mean).sum()
                + (weight * (mean - new.motion.carrier)).sum()
                + (viscous * mean).sum()
                + dissipated,
            ),
            MomentumBudget(
                change=(before.mass * components(after.v - before.v)).sum(axis=1),
                gravity=(share * weight).sum(axis=0),
                body_force=(share * body).sum(axis=0),
                boundary=(share * (boundary + missed)).sum(axis=0),
                friction=(share * friction).sum(axis=0),
                elastic=(share * elastic).sum(axis=0),
                viscous=(share * viscous).sum(axis=0),
                transfer=gained_p2g + (before.mass * beside).sum(axis=1),
            ),
        )

    numbers = jnp.arange(steps, dtype=particles.x.dtype)
    return jax.lax.scan(stepped, particles, numbers)


def _gathered(scene: Scene, stencil: Stencil, nodes: NodeVector) -> Gathered:
    """A velocity field of the nodes [m/s], shape (n, d), gathered for the scene's transfer."""
    value, gradient = gather(stencil, nodes)
    affine = jnp.swapaxes(gather(stencil.least_squares, nodes)[1], 0, 1) if scene.transfer.affine else None
    return Gathered(value, jnp.swapaxes(gradient, 0, 1), affine)


def _mismatch(
    stencil: Stencil, mass: Array, v: Float[Array, "d p"], C: Matrix | None, nodes: NodeVector
) -> tuple[Float[Array, ""], Float[Array, "d"]]:
    """½ Σ_ip w m ‖v_i − u_ip‖² and Σ_ip w m (v_i − u_ip), u_ip = v_p + C_p (x_i − x_p)."""
    weight = stencil.weight
    safe = jnp.where(weight == 0, 1, weight)[:, None]  # where the weight is zero the arm does not matter
    arm = stencil.moment * stencil.least_squares.gradient / safe  # x_i − x_p, (k, d, p)

    def add(total: tuple[Array, Array], stencil_node: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        i, w, r = stencil_node
        u = v if C is None else v + (C * r).sum(axis=1)
        gap = nodes[i].T - u
        return (total[0] + (w * mass * gap**2).sum() / 2, total[1] + (w * mass * gap).sum(axis=1)), None

    zero = jnp.zeros((), v.dtype), jnp.zeros(v.shape[0], v.dtype)
    return jax.lax.scan(add, zero, (stencil.index, weight, arm))[0]
