"""The faces of a scene's particles, as contact with surfaces knows them in a step."""

import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import EXPLICIT_STIFFNESS, IMPLICIT_STIFFNESS, Faces, FaceShape
from mpmjax.discretisation import Stencil
from mpmjax.state import MaterialPoints, Particles, Scene


def faces_of(
    scene: Scene,
    particles: Particles,
    materials: tuple[MaterialPoints, ...],
    stencil: Stencil,
    dt: Scalar,
    force_at: Scalar | None = None,
) -> Faces | None:
    """The faces of prepared particles; None if no boundary of the scene asks for them.

    Args:
        scene: the scene.
        particles: prepared particles.
        materials: their materials.
        stencil: their stencil.
        dt: step [s].
        force_at: the share of the step's displacement at which forces are evaluated; None if the step is explicit.
    """
    if not any(boundary.pushes or boundary.sees_faces for boundary in scene.boundary):
        return None
    shapes, areas, explicit = [], [], force_at is None
    factor = EXPLICIT_STIFFNESS if explicit else IMPLICIT_STIFFNESS
    for law, points in zip(scene.laws, materials, strict=True):
        side = points.volume ** (1 / particles.dim)
        shape = points.deformation if law.allows_total else points.volume_ratio()
        shapes.append(FaceShape(side / 2, shape, points.rows, points.total))
        # of a sliver A = V0/l0 is large for its mass, and would shorten explicit steps
        areas.append(points.volume / (side.max(initial=0) if explicit else side))
    per_modulus = jnp.concatenate(areas) * (factor / jnp.asarray(scene.grid.spacing))
    return Faces(
        x=particles.x,
        v=particles.v,
        shapes=tuple(shapes),
        stiffness=per_modulus * contact_moduli(scene, particles, materials),
        inertia=per_modulus * particles.mass / particles.volume,
        stencil=stencil,
        spacing=jnp.asarray(scene.grid.spacing),
        dt=jnp.asarray(dt),
        force_at=0.0 if force_at is None else jnp.asarray(force_at, particles.x.dtype),
        explicit=explicit,
    )


def contact_moduli(scene: Scene, particles: Particles, materials: tuple[MaterialPoints, ...]) -> Float[Array, "p"]:
    """The modulus of contact [Pa] of each prepared particle, shape (p,) (see `AbstractLaw.contact_modulus`)."""
    each = zip(scene.laws, materials, particles.histories, strict=True)
    return jnp.concatenate([law.contact_modulus(points.deformation, history) for law, points, history in each])
