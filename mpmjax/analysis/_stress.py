"""Stress and density of particles, and the numbers that are plotted of them."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, ParticleScalar, components
from mpmjax.analysis._budget import energy_density
from mpmjax.checks import canonical, checked
from mpmjax.discretisation import BSpline, gather, in_space, scatter
from mpmjax.state import Particles, Scene, prepare, velocity_gradient


@checked
def stress(scene: Scene, particles: Particles) -> Float[Array, "p 3 3"]:
    """The Cauchy stress σ of each particle [Pa], tension positive, shape (p, 3, 3).

    σ = P Fᵀ/J + σ_v, of the elastic law for the present history, with the viscous stress where a law has one, and with
    averaged volumes at F̄ (see `AveragedVolume`). Two dimensions are plane strain and one is uniaxial strain, with
    stresses normal to the plane or the line; of bodies of revolution the axes are r, z and around the axis.

    *When it breaks*: of material that yielding has loosened or torn, J counts the volume without its gaps. Stresses
    oscillate from particle to particle, by about as much as they are; `analysis.smoothed` averages them.
    """
    return _stress_and_ratio(canonical(scene, particles.x.dtype), particles)[0]


@checked
def pressure(scene: Scene, particles: Particles) -> ParticleScalar:
    """The pressure −tr σ/3 of each particle [Pa], compression positive, shape (p,) (see `stress`)."""
    return -jnp.trace(stress(scene, particles), axis1=1, axis2=2) / 3


@checked
def von_mises(scene: Scene, particles: Particles) -> ParticleScalar:
    """The von Mises stress √(3/2 ‖dev σ‖²) of each particle [Pa], shape (p,) (see `stress`)."""
    sigma = stress(scene, particles)
    s = sigma - jnp.trace(sigma, axis1=1, axis2=2)[:, None, None] / 3 * jnp.eye(3, dtype=sigma.dtype)
    square = 1.5 * (s**2).sum(axis=(1, 2))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)  # the root has no slope at zero


@checked
def density(scene: Scene, particles: Particles) -> ParticleScalar:
    """The density m/(V0 J) of each particle [kg/m^d], shape (p,), without gaps (see `stress`); zero without mass."""
    ratio = _stress_and_ratio(canonical(scene, particles.x.dtype), particles)[1]
    return particles.mass / (jnp.where(particles.volume > 0, particles.volume, 1) * ratio)


@checked
def smoothed(scene: Scene, particles: Particles, values: ParticleScalar) -> ParticleScalar:
    """Averages of values over the particles around each one, shape (p,), for pictures: the values Σ_p w V0_p f_p /
    Σ_p w V0_p at the middles of cells, interpolated back, with weights w of the scene's kernel of one order less (a
    linear kernel's at the nodes). In one dimension Σ_p w V0_p P_p/dx is the force through the middle of a cell by the
    balance of nodes, with the spline's gradient at rest: right beside a material of any stiffness too.
    """
    scene, particles = canonical(scene, particles.x.dtype), prepare(scene, particles)
    if scene.kernel.order > 1:
        scene = eqx.tree_at(lambda s: s.kernel, scene, BSpline(scene.kernel.order - 1))
        shifted = scene.anchor(particles) + scene.grid.spacing / 2
        particles = replace(particles, **{"X" if scene.total else "x": shifted})
    stencil = scene.stencil(particles)
    volume = particles.volume
    sums = scatter(stencil, jnp.stack([volume * values, volume]), None, scene.grid.size)
    nodes = sums[:, 0] / jnp.where(sums[:, 1] > 0, sums[:, 1], 1)
    return gather(stencil, nodes[:, None])[0][0]


FIELDS: dict[str, tuple[str, Callable[[Scene, Particles], Array]]] = {
    "speed": ("speed [m/s]", lambda scene, q: jnp.linalg.norm(q.v, axis=1)),
    "energy": ("elastic energy density [J/m^d]", energy_density),
    "stress": ("Cauchy stress [Pa]", stress),
    "pressure": ("pressure [Pa]", pressure),
    "von_mises": ("von Mises stress [Pa]", von_mises),
    "density": ("density [kg/m^d]", density),
    "material": ("material", lambda scene, q: jnp.asarray(np.repeat(1 + np.arange(len(q.sizes)), q.sizes), "int32")),
    "mass": ("mass [kg]", lambda scene, q: q.mass),
    "volume": ("undeformed volume [m^d]", lambda scene, q: q.volume),
    "particle": ("particle", lambda scene, q: jnp.arange(q.count, dtype="int32")),
}
"""The numbers of each prepared particle beside its state: a label, and an array with a row a particle.
Materials are numbered from 1, as in scene files, particles from 0."""


@eqx.filter_jit
def fields_of(scene: Scene, particles: Particles, names: tuple[str, ...]) -> dict[str, Array]:
    """Some of `FIELDS`, by one compiled program."""
    return {name: FIELDS[name][1](scene, particles) for name in names}


@eqx.filter_jit
def _stress_and_ratio(scene: Scene, particles: Particles) -> tuple[Float[Array, "p 3 3"], ParticleScalar]:
    """σ [Pa] and J [-] of each particle."""
    particles = prepare(scene, particles)
    stresses, ratios = [], []
    for points, law, group in zip(scene.material_points(particles), scene.laws, particles.groups, strict=True):
        elastic, F = points.law.in_space(points.strained(points.deformation))
        J = elastic.measure.determinant(F) * law.compaction(group.history)
        sigma = elastic.measure.kirchhoff_stress(elastic.stress(F), F, 3) / J
        if points.viscosity is not None:
            C = particles.C if particles.C is not None else velocity_gradient(scene, particles)
            L, v = points.rows_of(components(C)), points.rows_of(components(particles.v))
            if scene.grid.axisymmetric:
                L = in_space(points.rows_of(scene.anchor(particles)[:, 0]), v, L)
            if scene.total:
                L = la.matmul(L, la.transpose(la.cofactor(points.deformation)) / la.determinant(points.deformation))
            missing = (0, 3 - len(L))
            sigma = sigma + points.viscosity.stress(jnp.pad(L, (missing, missing, (0, 0))))
        stresses.append(sigma)
        ratios.append(jnp.broadcast_to(J, points.volume.shape))
    return jnp.moveaxis(jnp.concatenate(stresses, axis=-1), -1, 0), jnp.concatenate(ratios)
