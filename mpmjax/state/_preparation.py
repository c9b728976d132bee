"""Preparation: particles are given what a scene's laws, transfer and description need, and both are checked."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, ParticleMatrix, components, particle_first
from mpmjax.checks import (
    canonical,
    checked,
    is_traced,
    require,
    require_fields,
    require_finite,
    require_memory,
    require_placement,
    requirements,
)
from mpmjax.discretisation import APIC, average, gather, in_window
from mpmjax.material import AbstractLaw
from mpmjax.state._attachment import AttachedPoints, keeps_deformation
from mpmjax.state._particles import Group, Particles, moves_as_one, of_one_material
from mpmjax.state._scene import Scene
from mpmjax.state._setup_warnings import warn_of_setup

_FLAT_POWER = 0.6
"""Power of the rounding ε: neighbours whose spread in a direction is ε^0.6 of a whole stencil's say nothing of it."""
_ROUNDING = 1e3  # changes of velocity over a spacing below so many roundings are set to zero


@checked
def attach(scene: Scene, particles: Particles) -> Scene:
    """The scene with its loads attached to the particles as they are: each `Patch` of a surface and all `PointsAt`
    become points that move with the nearest particle.

    Raises:
        ValueError: a place with no surface, or with a point off the body; particles inside a jax transformation.
    """
    if not scene.loads:
        return scene
    with jax.ensure_compile_time_eval():  # what is known stays so within a transformation
        flat = replace(particles, volume=scene.grid.section(particles.x, particles.volume))
        places = [load.on.attached(flat) for load in scene.loads]
        if scene.grid.axisymmetric:
            places = [place.revolved(particles) for place in places]
        each = zip(scene.loads, places, strict=True)
        loads = tuple(eqx.tree_at(lambda load: load.on, load, place) for load, place in each)
    return eqx.tree_at(lambda s: s.loads, scene, loads)


@checked
def prepare(scene: Scene, particles: Particles) -> Particles:
    """Add to the particles what the scene's laws, transfer and description need, where it is missing.

    F = I (J = 1), the history of what never yielded, X = x in the total description (and none in the updated one), and
    with APIC or viscosity (and none without) the C of the velocities: the slope of the linear field that fits those of
    the neighbours, zero where all are alike. Velocities that are changed afterwards need a C of their own.

    Of particles that meet a scene for the first time it warns where walls or colliders lie over them, grips or
    colliders touch nothing, a body is thinner than two cells, moduli jump by more than a hundred within a cell, and
    positions are so far from zero that their precision rounds them to more than 2⁻¹² spacings.

    Raises:
        ValueError: a value is not as its module requires (`equinox.tree_at` can make it so), the particles have
            another dimension than the grid or another number of materials than the scene, a particle lies outside the
            window or beyond a mirrored plane, or a deformation gradient is one the law does not allow.
    """
    require_placement((scene, particles))
    require_fields(scene)  # what eqx.tree_at may have put past its constructor
    p, d = particles.count, particles.dim
    require(d == scene.grid.dim, f"The particles are {d}-dimensional, the grid {scene.grid.dim}-dimensional.")
    requirements((scene, particles))
    scene, several = canonical(scene, particles.x.dtype), len(scene.laws) > 1
    require(
        not several or len(particles.sizes) == len(scene.laws),
        f"The scene has {len(scene.laws)} laws, so the particles must be {len(scene.laws)} sets joined by mpmjax.join, "
        f"in the laws' order, got {len(particles.sizes)}.",
    )
    _check_loads(scene, particles)
    first = not jax.tree.leaves(particles.deformations)
    if not several:
        fields = ("deformations", "histories")
        particles = replace(particles, counts=None, **{f: (of_one_material(getattr(particles, f)),) for f in fields})
    require(
        not scene.total or particles.X is not None or first,
        "In the total description particles with an F need the X from which it is measured: give X, or drop F.",
    )
    # of known numbers NumPy makes arrays: each operation of JAX by itself is a program to compile
    xp: Any = jnp if is_traced((scene, particles)) else np
    common, pairs = (particles.x.dtype, scene.grid.strain_dim, xp), zip(scene.laws, particles.groups, strict=True)
    materials = [_prepared(law, group, *common) for law, group in pairs]
    C = particles.C
    if scene.keeps_gradient and C is None:
        C = jax.device_put(xp.zeros((p, d, d), particles.x.dtype))
    deformations, histories = zip(*materials, strict=True)
    C, X = C if scene.keeps_gradient else None, scene.anchor(particles) if scene.total else None
    prepared = replace(particles, deformations=deformations, histories=histories, C=C, X=X)
    # the arrays of a step: mass, momentum, velocity and force of the nodes; the state before and after it; the stencil
    n, state = scene.grid.size, sum(leaf.size for leaf in jax.tree.leaves(prepared))
    numbers = n * (1 + 3 * d) + 2 * state + p * 3 * d * (scene.kernel.order + 1)
    require_memory(
        f"A step of {p} particles on a grid of {n} nodes",
        numbers * particles.x.dtype.itemsize,
        f"take a smaller shape than {scene.grid.shape}, or fewer particles_per_cell.",
        device=True,
    )
    if not is_traced((scene, prepared)):
        _check_placement(scene, prepared)
        if first:
            warn_of_setup(scene, replace(prepared, volume=scene.grid.section(prepared.x, prepared.volume)))
    if not scene.keeps_gradient or particles.C is not None or moves_as_one(particles):
        return prepared
    return replace(prepared, C=velocity_gradient(scene, prepared))


def _check_loads(scene: Scene, particles: Particles) -> None:
    """Check that loads are attached to particles that there are, and whose law keeps what they need."""
    for load in scene.loads:
        name, on = type(load).__name__, load.on
        require(
            isinstance(on, AttachedPoints),
            f"The {name} is on a {type(on).__name__} that is not attached to particles yet: call "
            "scene = mpmjax.attach(scene, particles) first.",
        )
        if is_traced(on):
            continue
        rows = np.asarray(getattr(on, "particle", ()))
        require(
            (rows >= 0) & (rows < particles.count),
            f"The {name} is attached to particle {rows.max():.0f}, but there are {particles.count}: attach it to these "
            "particles.",
        )
        for law, group in zip(scene.laws, particles.groups, strict=True):
            there = (rows >= group.rows.start) & (rows < group.rows.stop)
            require(
                not load.needs_deformation() or keeps_deformation(law) or not there.any(),
                f"A following {name} needs the whole deformation gradient, which {law.title()} does not keep: take "
                "following=False, or a Traction.",
            )


def _prepared(law: AbstractLaw, group: Group, dtype: Any, dim: int, xp: Any) -> tuple[Array, Any]:
    """Deformation, with so many rows, and history of one material's particles, of which `xp`, NumPy or JAX, makes what
    is missing."""
    count = group.rows.stop - group.rows.start
    leaves = jax.tree.leaves(law, is_leaf=is_foreign)  # the numbers of networks and the like are their own
    shapes, fitting = {jnp.shape(a) for a in leaves if eqx.is_array_like(a)}, {(), (1,), (count,)}
    require(
        shapes <= fitting,
        f"{law.title()}'s parameters must be one number or one for each of its {count} particles, got shapes "
        f"{sorted(shapes - fitting)}. What has another shape, as a network's weights, belongs in an equinox.Module "
        "within the law.",
    )
    kept = law.measure
    undeformed = kept.undeformed(dim)
    shape, stored = (count, *undeformed.shape), group.stored
    if stored is None:
        stored = jax.device_put(xp.broadcast_to(undeformed.astype(dtype), shape))
    require(stored.shape == shape, f"{law.title()} needs {kept.symbol} of shape {shape}, got {stored.shape}.")
    if group.history is not None and law.remembers(group.history, stored):
        return stored, group.history
    initial = None if law.remembers(None, stored) else _initial_history(law, stored)
    require(
        group.history is None or initial is None,
        f"{law.title()} needs a history of its own, got {type(group.history).__name__}: drop it to start anew.",
    )
    return stored, initial


def is_prepared(scene: Scene, particles: Particles) -> bool:
    """Whether the particles have exactly what the scene needs."""

    def fits(law: AbstractLaw, group: Group) -> bool:
        shape = law.measure.undeformed(scene.grid.strain_dim).shape
        stored = group.stored
        return stored is not None and stored.shape[1:] == shape and law.remembers(group.history, stored)

    return (
        (particles.C is not None) == scene.keeps_gradient
        and (particles.X is not None) == scene.total
        and len(scene.laws) == len(particles.sizes)
        and all(fits(law, group) for law, group in zip(scene.laws, particles.groups, strict=True))
    )


def is_foreign(node: Any) -> bool:
    """Whether a part of a law is a module of another kind, such as a network, whose numbers are its own."""
    return isinstance(node, eqx.Module) and not isinstance(node, AbstractLaw)


@eqx.filter_jit
def _initial_history(law: AbstractLaw, stored: Array) -> Any:
    return law.initial_history(components(stored))


@eqx.filter_jit
def _fits(scene: Scene, particles: Particles) -> tuple[Bool[Array, "p"], list[Bool[Array, "q"]]]:
    """Whether each particle's stencil lies in the window, and whether its law allows its deformation, one array (q,) a
    material."""
    inside = in_window(scene.kernel, scene.grid, scene.window(particles), scene.anchor(particles))
    return inside, [points.is_admissible(points.deformation) for points in scene.material_points(particles)]


def _check_placement(scene: Scene, particles: Particles) -> None:
    x = np.asarray(scene.anchor(particles))
    require_finite("Particle positions", particles.x)
    require_finite("Particle velocities", particles.v)
    for boundary in scene.boundary:
        for wall in boundary.walls():
            name, keep = type(boundary).__name__, "above" if wall.inward > 0 else "below"
            beyond = wall.inward * (x[:, wall.axis] - np.asarray(wall.position)) < 0
            require(
                not wall.mirrored or ~beyond,
                f"Particles must lie {keep} the {name} at {wall.position:g} on axis {wall.axis}, but particle "
                f"{int(np.argmax(beyond))} does not: move it or change the plane's keep.",
            )
    bare = scene
    if scene.volume is None:  # scenes with other boundaries and loads share the program then
        bare = Scene(
            scene.grid, scene.material, kernel=scene.kernel, description=scene.description, bodies=scene.bodies
        )
    inside, admissible = jax.tree.map(np.asarray, _fits(bare, particles))
    at_rest = scene.total or not scene.moving_mirrors  # else the grid is where the time says
    if at_rest and not inside.all():
        first = int(np.argmin(inside))
        raise ValueError(
            f"Every particle's stencil must lie in the window; particle {first} at {x[first]} and "
            f"{int((~inside).sum()) - 1} others do not: enlarge the grid's shape, move its origin, or use follow=True."
        )
    for constraint in scene.constraints:
        rows = particles.groups[constraint.number].rows
        constraint.check_particles(np.asarray(particles.x[rows], float), float(scene.grid.spacing))
    for law, group, allowed in zip(scene.laws, particles.groups, admissible, strict=True):
        kept, first = law.measure, int(np.argmin(allowed)) + group.rows.start
        require(
            allowed,
            f"{type(law).__name__} does not allow the {kept.symbol} of particle {first} (most laws need "
            f"{kept.volume} > 0): start from an admissible one.",
        )


@eqx.filter_jit
def velocity_gradient(scene: Scene, particles: Particles) -> ParticleMatrix:
    """The velocity gradient C [1/s] of prepared particles by the velocities of their neighbours, shape (p, d, d).

    It is the slope of the linear field that fits, by least squares, the mean velocities v̄_i that the nodes of a
    particle's stencil have at the middle x̄_i of their mass,

        C = Q M⁻¹,    Q = Σ_i w_ip v̄_i (x̄_i − ȳ)ᵀ,    M = Σ_i w_ip (x̄_i − ȳ)(x̄_i − ȳ)ᵀ,    ȳ = Σ_i w_ip x̄_i,

    so that it is that of a linear field at free surfaces too, and linear in the velocities. In directions in which the
    neighbours do not spread, it is zero.
    """
    affine = eqx.tree_at(lambda s: s.transfer, scene, APIC())  # for the gradient of moving least squares
    stencil, size = affine.stencil(particles).least_squares, scene.grid.size
    v = components(particles.v)
    d, D, at_rest = len(v), stencil.moment, jnp.zeros_like(v)
    axes = la.identity_like(jnp.zeros((d, *v.shape), v.dtype))

    # at the nodes v̄_i less the velocity of one particle, and s_i = x̄_i − x_i, where w_ip (x_i − x_p) = D g_ip
    mass = particles.mass
    rows, slopes = jnp.concatenate([v - v[:, :1], at_rest]), jnp.concatenate([jnp.zeros_like(axes), -D * axes])
    least = jnp.finfo(v.dtype).eps * mass.min()
    _, nodes = average(stencil, mass, mass * rows, jnp.swapaxes(mass * slopes, 0, 1), least, size)
    products = nodes[:, :, None] * nodes[:, None, d:]
    value, gradient = gather(stencil, jnp.concatenate([nodes, products.reshape(size, -1)], axis=1))

    # Σ_i w a_i (x̄_i − x_p)ᵀ of a = v̄ and s, where Σ_i w a_i (x_i − x_p)ᵀ = ∇a D
    mean, shift = value[: 2 * d], value[d : 2 * d]
    along = jnp.swapaxes(gradient[:, : 2 * d], 0, 1) * D
    moments = along + value[2 * d :].reshape(2 * d, d, -1) - mean[:, None] * shift
    Q, M = moments[:d], moments[d:] + la.transpose(along[d:]) + D * axes
    M = M / scene.grid.spacing**2
    square = la.matmul(M, M) + (jnp.finfo(v.dtype).eps ** _FLAT_POWER / 4) ** 2 * axes
    inverse = la.matmul(M, la.cofactor(square)) / la.determinant(square)  # M⁻¹, and zero where M is
    C = la.matmul(Q, inverse) / scene.grid.spacing**2
    small = jnp.abs(C) * scene.grid.spacing <= _ROUNDING * jnp.finfo(v.dtype).eps * jnp.abs(v).max()
    return particle_first(C - jax.lax.stop_gradient(jnp.where(small, C, 0)))
