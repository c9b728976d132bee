"""One step: P2G, the grid update by an integrator, G2P, and the return maps of laws that yield."""

from dataclasses import replace
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Int, NodeVector, Scalar, components, particle_first
from mpmjax.autodiff import without_derivative
from mpmjax.boundary import ContactInfo, Impulses
from mpmjax.checks import canonical, checked, require_finite, require_placement, require_positive
from mpmjax.discretisation import Stencil, g2p, in_space, scatter
from mpmjax.implicit import SolveInfo
from mpmjax.potential import Forces
from mpmjax.state import Particles, Scene, State, is_prepared, prepare, with_state
from mpmjax.stepping._boundary_forces import impulse_on_boundaries, impulse_on_colliders
from mpmjax.stepping._grid_update import GridUpdate, constrained_update
from mpmjax.stepping._integrator import AbstractIntegrator, Explicit, NodeMotion
from mpmjax.stepping._nodes import Nodes, folded_at_planes, particles_to_grid, with_boundaries


class StepInfo(eqx.Module):
    """The report of one step."""

    solve: SolveInfo  # the report of the implicit solve
    contact: ContactInfo  # the report of contact
    outside: Int[Array, "*f"]  # particles whose stencil left the grid's window
    force_error: Float[Array, "*f"]
    """Norm over all nodes, held ones too, of the difference between the elastic force that moved the nodes and the
    law's force for the same displacement [N]: by the linearisation of one linear solve, and by the return maps of
    laws that yield, which follow the solve. Zero in explicit steps, and with Newton's method where nothing yields."""
    force_scale: Float[Array, "*f"]
    """The largest of four such norms [N]: of the two forces, of the force at the start, and of the nodes' momentum
    over Δt. The momentum of what yields counts only by its rounding, √ε of it."""
    colliders: Impulses | None = None
    """Impulse on the scene's colliders, in the order of its boundaries; None without colliders."""
    boundaries: Impulses | None = None
    """Impulse on each of the scene's boundaries; None unless the scene has `boundary_forces`."""

    @property
    def linearisation_error(self) -> Float[Array, "*f"]:
        """`force_error` over its scale [-], zero if both are."""
        return self.force_error / jnp.where(self.force_scale == 0, 1, self.force_scale)


def step_unchecked(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    method: AbstractIntegrator,
    stencil: Stencil | None = None,
) -> tuple[Particles, StepInfo]:
    """One step, without checks or compilation: `step` is its public form. The floats of the scene are arrays of the
    particles' dtype, and the particles are prepared; their stencil may be known already, as in the total description.
    """
    force_at = method.force_at()
    if stencil is None:
        stencil = scene.stencil(particles, t)
    if scene.correction is not None:
        with jax.named_scope("correction"):
            particles = scene.correction.corrected(scene, particles, stencil, t, dt)
    with jax.named_scope("p2g"):
        unfolded = nodes = particles_to_grid(
            scene,
            particles,
            t,
            dt,
            stencil,
            body_force_at=method.body_force_at,
            explicit_viscosity=method.explicit_viscosity,
            joined=not (method.needs_separate_force or scene.transfer.needs_change or scene.constraints),
        )
    if scene.boundary or scene.bodies is not None or scene.constraints:
        with jax.named_scope("boundaries"):
            unfolded = with_boundaries(scene, particles, nodes, t, force_at)
            nodes = folded_at_planes(scene, particles, unfolded, t)
    with jax.named_scope("grid_update"):
        new = update(nodes, method)
    with jax.named_scope("g2p"):
        trial = grid_to_particles(scene, particles, nodes, new)
    with jax.named_scope("return_map"):
        after = scene.return_map(trial, dt)

    # what the step reports
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros((), particles.x.dtype)
    error, scale, colliders, boundaries = zero, zero, None, None
    if force_at is not None and new.elastic is not None:
        error, scale = force_error(scene, nodes, method, force_at, new.solved, new.elastic, trial, after)
    if scene.collider_count:
        colliders = impulse_on_colliders(scene, particles, t, unfolded, nodes, method, new)
    if scene.boundary_forces:
        boundaries = impulse_on_boundaries(scene, particles, t, unfolded, nodes, method, new)
    return after, StepInfo(
        solve=new.solve,
        contact=ContactInfo(none, none) if new.contact is None else new.contact,
        outside=(~stencil.inside).sum().astype(jnp.int32),
        force_error=error,
        force_scale=scale,
        colliders=colliders,
        boundaries=boundaries,
    )


step_compiled = eqx.filter_jit(step_unchecked)  # `step_unchecked`, compiled as one program


def update(nodes: Nodes, method: AbstractIntegrator) -> GridUpdate:
    """The grid update by an integrator, with contact and friction where the scene has any."""
    if nodes.contacts or nodes.walls:
        new = constrained_update(nodes, method)
    else:
        motion, info = method.advance(nodes, method.initial_guess(nodes))
        new = GridUpdate(motion, motion, None if nodes.f is None else method.elastic_impulse(nodes, motion), info)
    if not method.explicit_viscosity and new.motion.resisted is None and nodes.potential.viscous:
        raise ValueError(
            f"{type(method).__name__} has explicit_viscosity = False, so its advance must return the velocity that "
            "viscosity resists, NodeMotion.resisted. It returned None."
        )
    return new


def grid_to_particles(scene: Scene, particles: Particles, nodes: Nodes, new: GridUpdate) -> Particles:
    """G2P: the particles after the step, with x ← x + Δt Σ w v̄_i and F ← F + Δt Σ v̄_i h_iᵀ. For laws that yield this F
    is the trial F_E of `Scene.return_map`."""
    potential, dt, motion = nodes.potential, nodes.dt, new.motion
    before = new.before(nodes) if scene.transfer.needs_change else None
    if potential.mirror.images:
        before, motion = jax.tree.map(potential.mirror.unfold, (before, motion))
    radius, points = potential.stencil.radius, potential.material_points
    together = len(points) == 1 and points[0].strained_by_gradient and radius is None  # F is moved by G2P itself
    gathered = g2p(
        scene.transfer,
        potential.stencil,
        dt,
        components(particles.x),
        components(particles.v),
        before,
        motion.velocity,
        motion.mean,
        C=None if particles.C is None else components(particles.C),
        F=points[0].deformation if together else None,
        keep_gradient=scene.keeps_gradient,
    )
    if gathered.F is not None:
        deformations = [gathered.F]
    else:
        grad_v = gathered.gradient if radius is None else in_space(radius, gathered.carrier, gathered.gradient)
        deformations = [q.deformation + dt * q.change(q.rows_of(grad_v)) for q in points]
    after = State(
        x=particle_first(gathered.x),
        v=particle_first(gathered.velocity),
        C=None if gathered.affine is None else particle_first(gathered.affine),
        deformations=tuple(map(particle_first, deformations)),
        histories=particles.histories,
    )
    moved = with_state(particles, after)
    for constraint, image in zip(scene.constraints, nodes.tied, strict=True):
        end, mean = new.motion.velocity, new.motion.carrier
        moved = constraint.moved(particles, moved, image, nodes.conditions.fixed, end, mean, dt)
    return moved


def force_error(
    scene: Scene,
    nodes: Nodes,
    method: AbstractIntegrator,
    force_at: Scalar,
    motion: NodeMotion,
    elastic: NodeVector,
    trial: Particles,
    after: Particles,
) -> tuple[Array, Array]:
    """`StepInfo.force_error` and `force_scale` of an implicit step, from the motion of the nodes before friction, the
    impulse of elastic forces that made it [kg m/s], shape (n, d), the particles after G2P, and those after the return
    maps. No derivative passes."""
    frozen = without_derivative((nodes, method, force_at, motion, elastic, trial, after))
    nodes, method, force_at, motion, elastic, trial, after = frozen
    mass, yields = nodes.mass, any(law.relaxes_stress for law in scene.laws)
    if not method.linearises and not yields:
        return jnp.zeros((), mass.dtype), jnp.zeros((), mass.dtype)
    exact = method.exact_impulse(nodes, motion) if method.linearises else elastic
    if yields:  # the solve's forces went the share θ of the way to the trial stress, the law's go to the returned one
        tried, returned = (
            replace(nodes.potential, material_points=scene.material_points(q)).weighted_stress() for q in (trial, after)
        )
        relaxed = nodes.potential.on_nodes([Forces(slopes=la.transpose(tried - returned))])
        exact = exact + force_at * nodes.dt * relaxed
        # what slows flow counts however small it is beside the momentum of what flows, but for its rounding
        mass = jnp.finfo(mass.dtype).eps ** 0.5 * mass
        stays = np.repeat([not law.relaxes_stress for law in scene.laws], trial.sizes)
        if stays.any():
            sums = scatter(nodes.potential.stencil, jnp.where(stays, trial.mass, 0)[None], None, nodes.potential.size)
            mass = mass + nodes.potential.mirror.fold_scalar(sums[:, 0])
    momentum = mass[:, None] * motion.velocity
    norms = [jnp.linalg.norm(a) for a in (exact, elastic, nodes.dt * nodes.force, momentum)]
    return jnp.linalg.norm(exact - elastic) / nodes.dt, reduce(jnp.maximum, norms) / nodes.dt


@checked
def step(
    scene: Scene, particles: Particles, t: Scalar, dt: Scalar, *, method: AbstractIntegrator = Explicit()
) -> tuple[Particles, StepInfo]:
    """One step of the Material Point Method, from t to t + dt.

    P2G; the update of the nodes' velocity by `method`; G2P with x ← x + Δt Σ_i w_ip v̄_i and F ← F + Δt Σ_i v̄_i h_ipᵀ;
    the return map of laws that yield. v̄ is v^{n+1} or, for methods of second order, the mean velocity over the step.

    Reverse mode through a loop of steps stores all that a step computes. Under `jax.checkpoint` it stores the particles
    and computes the step again (57 in place of 235 B a particle and explicit step in 2-D and float32):

        body = jax.checkpoint(lambda particles, t: (mpm.step(scene, particles, t, dt)[0], None))
        final, _ = jax.lax.scan(body, mpm.prepare(scene, particles), dt * jnp.arange(steps))

    Implicit solves are then done twice; `simulate` keeps their results and bounds the memory, by `checkpoint_bytes`.

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
