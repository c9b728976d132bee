"""Mass, momentum and energy of a state."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse.csgraph

from mpmjax._types import Array, Float, ParticleScalar, components
from mpmjax.checks import canonical, checked
from mpmjax.discretisation import p2g
from mpmjax.geometry import rigid_body
from mpmjax.state import Particles, Scene, prepare


class Energy(eqx.Module):
    """The energy of a state [J] (per metre of thickness in 2-D, per square metre of section in 1-D)."""

    kinetic: Float[Array, "*f"]
    """½ Σ m (‖v‖² + tr(C D Cᵀ)), with the affine part for APIC; of a rigid body ½ M ‖V‖² + ½ ω·Iω."""
    elastic: Float[Array, "*f"]
    """Σ V0 Ψ(F), with the elastic law for the present history."""
    potential: Float[Array, "*f"]
    """−Σ m g·x."""

    @property
    def total(self) -> Float[Array, "*f"]:
        """The sum of all three."""
        return self.kinetic + self.elastic + self.potential


@checked
def energy(scene: Scene, particles: Particles) -> Energy:
    """The energy of the particles.

    Args:
        scene: the scene.
        particles: its particles.
    """
    scene = canonical(scene, particles.x.dtype)
    return _energy(scene, prepare(scene, particles))


def energy_of(scene: Scene, particles: Particles) -> Energy:
    """The energy of prepared particles, without compilation."""
    speed2 = (particles.v**2).sum(axis=1)
    if scene.transfer.affine and particles.C is not None:
        speed2 = speed2 + (particles.C**2 * scene.stencil(particles).moment.T[:, None, :]).sum(axis=(1, 2))
    kinetic = particles.mass * speed2 / 2
    for material in scene.rigid_bodies:
        rows = slice(*particles.groups[material.number].rows)
        body = rigid_body(particles.x[rows], particles.v[rows], particles.mass[rows], particles.volume[rows])
        rigid = (body.mass * (body.velocity**2).sum() + body.spin @ body.inertia @ body.spin) / 2
        kinetic = kinetic.at[rows].set(0).at[rows.start].set(rigid)
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
    return _grid_mass(scene, prepare(scene, particles))


@eqx.filter_jit
def _grid_mass(scene: Scene, particles: Particles) -> Float[Array, ""]:
    stencil = scene.stencil(particles)
    nodes, _ = p2g(stencil, particles.mass, components(particles.v), None, scene.grid.size)
    return nodes.sum()


@checked
def pieces(scene: Scene, particles: Particles) -> int:
    """The number of pieces of the material. Particles with a common node of non-zero weight are of one piece.

    Pieces exchange neither momentum nor stress. In the updated description a body falls apart, whatever its law, when
    it is stretched until its particles lie further apart than the kernel reaches: *numerical fracture*. More pieces at
    the end of a run than at its start are a sign of it, unless the material was meant to part. `TotalLagrangian` and
    more particles a cell prevent it.
    """
    scene = canonical(scene, particles.x.dtype)
    stencil = scene.stencil(prepare(scene, particles))
    touching = np.asarray(stencil.weight) > 0
    particle = np.broadcast_to(np.arange(particles.count), touching.shape)[touching]
    _, node = np.unique(np.asarray(stencil.index)[touching], return_inverse=True)
    size = particles.count + int(node.max()) + 1
    edges = (np.ones(node.size, bool), (particle, particles.count + node))
    return scipy.sparse.csgraph.connected_components(scipy.sparse.coo_array(edges, (size, size)), directed=False)[0]
