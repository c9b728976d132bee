"""One step: particles to grid, the nodes' update by an integrator, grid to particles, return maps of laws that
yield."""

from dataclasses import replace
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Int, NodeVector, Scalar, components, particle_first
from mpmjax.autodiff import kept, without_derivative
from mpmjax.boundary import (
    BoundaryImpulse,
    ColliderImpulse,
    ConstrainedNodes,
    ContactInfo,
    Given,
    constrain,
    find_active_set,
    impulse_on_colliders,
    no_contact,
)
from mpmjax.checks import canonical, checked, require_finite, require_placement, require_positive
from mpmjax.discretisation import Stencil, g2p, scatter
from mpmjax.implicit import Projection, SolveInfo, no_solve
from mpmjax.state import Particles, Scene, is_prepared, prepare
from mpmjax.stepping._boundary_forces import given_to_boundaries
from mpmjax.stepping._explicit import Explicit
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._left_undone import LeftUndone, norm, nothing_left_undone
from mpmjax.stepping._nodes import Nodes, folded_at_planes, particles_to_grid
from mpmjax.stepping._rigid_layers import moved_rigidly


class StepInfo(eqx.Module):
    """The report of one step."""

    solve: SolveInfo
    contact: ContactInfo
    outside: Int[Array, "*f"]
    """Particles whose stencil left the grid's window."""
    left_undone: LeftUndone
    """The elastic force that one linear solve, or the return map after any solve, leaves undone; zero in explicit
    steps, and with Newton's method where nothing yields."""
    colliders: ColliderImpulse | None = None
    """Impulse on the scene's colliders, in the order of its boundaries; None without colliders."""
    boundaries: BoundaryImpulse | None = None
    """Impulse on each of the scene's boundaries; None unless the scene has `boundary_forces`."""


class GridUpdate(eqx.Module):
    """The nodes' motion over a step, and the impulses that made it."""

    before: NodeVector | None
    """v_i^n [m/s], shape (n, d), mirrored at active contact planes; None if P2G summed momentum and force together."""
    motion: NodeMotion
    """The motion of the nodes over the step, mirrored likewise."""
    internal: NodeVector | None
    """The impulse of internal forces [kg m/s], shape (n, d), elastic and viscous; None if P2G summed momentum and force
    together."""
    viscous: NodeVector | None
    """The viscous part of `internal` [kg m/s], shape (n, d); None without viscosity, or if it was not asked for."""
    reaction: NodeVector
    """The impulse of walls and grips [kg m/s], shape (n, d); in free components the residual of the solve."""
    friction: NodeVector | None
    """The impulse of friction [kg m/s], shape (n, d); None without contacts."""
    free: Projection
    """The projection on the components of velocity that no boundary acts on."""
    solve: SolveInfo
    contact: ContactInfo
    held: ConstrainedNodes
    """The nodes with what contacts hold."""
    solved: NodeMotion
    """`motion` before friction."""
    slowed: tuple[NodeVector, ...] = ()
    """The change of velocity by the friction of each contact [m/s], shape (n, d)."""
    along_normals: tuple[Given, ...] = ()
    """The impulses of colliders along their normals, by the colliders' numbers."""
    holding: NodeVector | None = None
    """The part of `reaction` that holds components of velocity, without springs [kg m/s], shape (n, d); None if that is
    all."""
    pushes: tuple[tuple[int, NodeVector], ...] = ()
    """The impulses of colliders by springs and friction [kg m/s], shape (n, d), each with its collider's number."""


def step_unchecked(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    method: AbstractIntegrator,
    stencil: Stencil | None = None,
) -> tuple[Particles, StepInfo]:
    """One step, without checks or compilation: `step` is its public form.

    Args:
        scene: the scene, its floats arrays of the particles' dtype.
        particles: prepared particles.
        t: time at the start of the step [s].
        dt: step [s].
        method: the integrator.
        stencil: stencil of the particles, if it is known already, as in the total description. Default: it is computed.
    """
    stencil = scene.stencil(particles, t) if stencil is None else stencil
    nodes = particles_to_grid(
        scene,
        particles,
        t,
        dt,
        stencil,
        body_force_at=method.body_force_at,
        force_at=method.force_at(),
        explicit_viscosity=method.explicit_viscosity,
        joined=not (method.needs_separate_force or scene.transfer.needs_change),
        folded=False,
    )
    unfolded, nodes = nodes, folded_at_planes(scene, particles, nodes)
    new = update(nodes, method)
    trial = grid_to_particles(scene, particles, nodes, new)
    after = scene.return_map(trial, dt)
    outside = (~stencil.inside).sum().astype(jnp.int32)
    boundaries = None
    if scene.boundary_forces:
        reaction = new.reaction
        if nodes.mirror.images:  # of all nodes
            reaction = impulses(unfolded, method, jax.tree.map(nodes.mirror.unfold, new.solved))[1]
        boundaries = given_to_boundaries(
            scene,
            particles,
            stencil,
            t,
            unfolded,
            nodes,
            reaction,
            new.before,
            new.solved.velocity,
            new.motion.carrier,
            method.force_at(),
            new.held,
            new.slowed,
        )
    undone = _left_undone(scene, nodes, method, new, trial, after)
    colliders = _given_to_colliders(nodes, method, new)
    return after, StepInfo(new.solve, new.contact, outside, undone, colliders, boundaries)


def _given_to_colliders(nodes: Nodes, method: AbstractIntegrator, new: GridUpdate) -> ColliderImpulse | None:
    """The impulse on the scene's colliders, at their places at the time of the forces; None without colliders."""
    colliders, share = nodes.conditions.colliders, method.force_at()
    if colliders is None:
        return None
    if share is not None:
        colliders = colliders.after(share * nodes.dt, nodes.mirror.unfold(new.motion.carrier))
    holding = new.reaction if new.holding is None else new.holding
    return impulse_on_colliders(colliders, holding, new.along_normals, new.pushes)


def _left_undone(
    scene: Scene, nodes: Nodes, method: AbstractIntegrator, new: GridUpdate, trial: Particles, after: Particles
) -> LeftUndone:
    """The elastic force that the step leaves undone by its linearisation, and by the return maps that follow its solve.
    No derivative passes."""
    nodes, method, new, trial, after = without_derivative((nodes, method, new, trial, after))
    exact, share = method.exact_impulse(nodes, new.solved), method.force_at()
    yields = any(law.relaxes_stress for law in scene.laws)
    if share is None or new.internal is None or (exact is None and not yields):
        return nothing_left_undone(nodes.mass.dtype)
    elastic = new.internal if new.viscous is None else new.internal - new.viscous
    exact = elastic if exact is None else exact
    if yields:  # the solve's forces went the share θ of the way to the trial stress, the law's go to the returned one
        tried, returned = (
            replace(nodes.potential, material_points=scene.material_points(q)).current_flux() for q in (trial, after)
        )
        exact = exact + share * nodes.dt * nodes.potential.nodal_sum(tried - returned)
    mass = nodes.mass
    if yields:  # what slows flow counts however small it is beside the momentum of what flows, but for its rounding
        mass = jnp.finfo(mass.dtype).eps ** 0.5 * mass
        stays = np.repeat([not law.relaxes_stress for law in scene.laws], trial.sizes)
        if stays.any():
            own = jnp.where(stays, trial.mass, 0)[None]
            sums = scatter(nodes.potential.stencil, own, None, nodes.potential.size)
            mass = mass + nodes.mirror.fold_scalar(sums[:, 0])
    inertia = norm(mass[:, None] * new.solved.velocity)
    scale = reduce(jnp.maximum, (norm(exact), norm(elastic), nodes.dt * norm(nodes.force), inertia))
    return LeftUndone(norm(exact - elastic) / nodes.dt, scale / nodes.dt)


step_compiled = eqx.filter_jit(step_unchecked)
"""`step_unchecked`, compiled as one program."""


def update(nodes: Nodes, method: AbstractIntegrator) -> GridUpdate:
    """The motion of the nodes by an integrator, with boundaries, contact and friction."""
    with jax.named_scope("update"):
        guess = method.initial_guess(nodes)
        if not nodes.contacts:
            motion, info = method.advance(nodes, guess)
            internal, reaction, viscous = impulses(nodes, method, motion)
            held = constrain(nodes, ())
            return GridUpdate(
                before=nodes.admitted_velocity() if nodes.separate else None,
                motion=motion,
                internal=internal,
                viscous=viscous,
                reaction=reaction,
                friction=None,
                free=nodes.projection,
                solve=info,
                contact=no_contact(),
                held=held,
                solved=motion,
                along_normals=held.along_normals(reaction),
            )

        def moved(
            held: ConstrainedNodes, method: AbstractIntegrator, guess: NodeVector
        ) -> tuple[ConstrainedNodes, NodeMotion, SolveInfo]:
            motion, info = method.advance(held.nodes, guess)
            motion = jax.tree.map(held.images.unfold, motion)
            return replace(held, displacement=method.mean_displacement(held.nodes, motion)), motion, info

        frozen, frozen_method, guess = without_derivative((nodes, method, guess))

        def attempt(held: ConstrainedNodes, guess: NodeVector) -> tuple:
            held, motion, info = moved(held, frozen_method, guess)
            missing = impulses(frozen, frozen_method, motion)[1]
            return held, motion.velocity, held.beside_springs(missing), motion.carrier, info

        start = frozen_method.mean_displacement(frozen, NodeMotion(guess))
        active, guess, cost, sweeps = kept(
            find_active_set(frozen, guess, start, attempt, no_solve(guess.dtype), explicit=method.is_explicit)
        )
        held, motion, info = moved(constrain(nodes, active), method, guess)
        internal, reaction, viscous = impulses(nodes, method, motion)
        holding = held.beside_springs(reaction)
        final, slowed = held.friction(motion.velocity, holding)
        change = final - motion.velocity
        return GridUpdate(
            before=held.images.unfold(held.nodes.admitted_velocity()) if nodes.separate else None,
            motion=motion.with_friction(change),
            internal=internal,
            viscous=viscous,
            reaction=reaction,
            friction=nodes.mass[:, None] * change,
            free=Projection(*held.beyond_boundaries()),
            solve=cost.followed_by(info),
            contact=ContactInfo(sweeps, held.count_violations(motion.velocity, holding)),
            held=held,
            solved=motion,
            slowed=slowed,
            along_normals=held.along_normals(holding),
            holding=holding,
            pushes=held.pushes(slowed),
        )


def impulses(
    nodes: Nodes, method: AbstractIntegrator, motion: NodeMotion
) -> tuple[NodeVector | None, NodeVector, NodeVector | None]:
    """The impulses over the step [kg m/s], each of shape (n, d): of internal forces, of walls and grips, and the
    viscous part of the first, as in `GridUpdate`."""
    if nodes.potential.viscous and not method.explicit_viscosity and motion.resisted is None:
        raise ValueError(
            f"{type(method).__name__} has explicit_viscosity = False, so its advance must return the velocity that "
            "viscosity resists, NodeMotion.resisted. It returned None."
        )
    if not nodes.separate:
        return None, nodes.mass[:, None] * (motion.velocity - nodes.explicit_velocity()), None
    internal, viscous = method.elastic_impulse(nodes, motion), None
    if motion.resisted is not None:
        viscous = -nodes.dt * nodes.potential.viscous_resistance(motion.resisted)
        internal = internal + viscous
    elif nodes.viscous_force is not None:
        viscous = jnp.where(nodes.occupied, nodes.dt * nodes.viscous_force, 0)
    return internal, nodes.mass[:, None] * (motion.velocity - nodes.inertial_velocity()) - internal, viscous


def grid_to_particles(scene: Scene, particles: Particles, nodes: Nodes, new: GridUpdate) -> Particles:
    """G2P: the particles after the step, with x ← x + Δt Σ w v̄_i and F ← F + Δt Σ v̄_i hᵀ. For laws that yield this F is
    the trial F_E of `Scene.return_map`."""
    potential, dt = nodes.potential, nodes.dt
    unfold = potential.mirror.unfold
    before, motion = jax.tree.map(unfold, (new.before, new.motion))
    with jax.named_scope("g2p"):
        found = g2p(
            scene.transfer,
            potential.stencil,
            components(particles.v),
            before,
            motion.velocity,
            motion.mean,
            C=None if particles.C is None else components(particles.C),
            keep_gradient=scene.keeps_gradient,
        )
        changes = zip(potential.current_deformation(), potential.change(found.gradient), strict=True)
        deformations = tuple(particle_first(F + dt * rate) for F, rate in changes)
    after = replace(
        particles,
        x=particle_first(components(particles.x) + dt * found.carrier),
        v=particle_first(found.velocity),
        deformations=deformations,
        C=None if found.affine is None else particle_first(found.affine),
    )
    if not scene.rigid_bodies:
        return after
    return moved_rigidly(
        scene,
        particles,
        after,
        potential.mirror,
        nodes.conditions.fixed,
        new.motion.velocity,
        new.motion.carrier,
        nodes.dt,
    )


@checked
def step(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    *,
    method: AbstractIntegrator = Explicit(),
) -> tuple[Particles, StepInfo]:
    """One step of the Material Point Method, from t to t + dt.

    P2G; the update of the nodes' velocity by `method`; G2P with x ← x + Δt Σ_i w_ip v̄_i and F ← F + Δt Σ_i v̄_i h_ipᵀ;
    the return map of laws that yield. v̄ is v^{n+1} or, for methods of second order, the mean velocity over the step.

    Args:
        scene: the scene.
        particles: the particles, prepared if they are not (see `prepare`).
        t: time at the start of the step [s].
        dt: step [s].
        method: the integrator: `Explicit()`, `SemiImplicit(...)`, `BackwardEuler(...)`, `ImplicitMidpoint(...)`,
            `TRBDF2(...)` or one of your own.

    Returns:
        the particles after the step, and a `StepInfo`. It says whether the solve converged and whether particles left
        the window; only `simulate` raises for either.

    Raises:
        ValueError: from `prepare`, a time that is not finite, or a dt that is not positive.
    """
    require_finite("t [s]", t)
    require_positive("dt [s]", dt, particles.x.dtype)
    require_placement((scene, particles))
    scene, t, dt, method = canonical((scene, t, dt, method), particles.x.dtype)
    particles = particles if is_prepared(scene, particles) else prepare(scene, particles)
    return step_compiled(scene, particles, t, dt, method)
