"""The longest stable step."""

import math
from itertools import combinations
from typing import Annotated, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, NodeScalar, Scalar
from mpmjax.boundary import STIFFNESS, AbstractContact, ConstrainedNodes, series_stiffness
from mpmjax.checks import canonical, checked, finite, is_traced, require, require_positive
from mpmjax.discretisation import Stencil
from mpmjax.geometry import length
from mpmjax.potential import Mirror
from mpmjax.state import MaterialPoints, Particles, Scene, is_prepared, points_of, prepare, terms_of, with_dust
from mpmjax.stepping._contact_surfaces import contact_moduli
from mpmjax.stepping._integrator import AbstractIntegrator, Explicit
from mpmjax.stepping._nodes import start_nodes

MOST_STEPS = 2**31 - 1  # the largest number of steps of a run
SAFETY = 0.7  # the default safety


class UnknownBoundError(ValueError):
    """An integrator, transfer, gradient operator or term gives no bound on the step."""


@checked
def stable_dt(
    scene: Scene,
    particles: Particles,
    *,
    method: AbstractIntegrator = Explicit(),
    safety: Scalar = SAFETY,
    t1: Scalar | None = None,
    t: Annotated[Scalar, finite, "s"] = 0.0,
) -> Float[Array, ""]:
    """The longest step Δt [s] for which motion about the present state of the particles does not grow.

    The limit of a particle alone on the grid is known exactly, and a set of particles has no lower limit than the
    lowest of its members (B. M. Irons, G. Treharne, Proc. 3rd Conf. on Matrix Methods in Structural Mechanics, 1971;
    derivation, section 12). So Δt is the least over particles of Δt² = 4 ρ0/(Λ (2Ξ − κa)) (eq. 32; at F = I
    4ρ0/((2μ + dλ)(2Ξ − κa))), with viscosity of Δt² Λ (2Ξ − κa)/ρ0 + Δt Λ_v B/ρ0 = 4 (eq. 34):

    - Λ is the largest eigenvalue of the symmetric part of the present tangent L ↦ ∂²Ψ/∂F∂F : (L F) Fᵀ + τ Lᵀ with
      L = ∇v and τ = P Fᵀ, by `principal_differential`; in the total description, that of ∂²Ψ/∂F∂F. Stretching and
      compression raise it. With averaged volumes it is that at F̄, or its average where that is larger.
    - Ξ is a for the moving-least-squares gradient. For the spline's it is the value at the particle in the total
      description, and in the updated one the largest in a cell: 6/dx² (quadratic) or 3.137/dx² (cubic).
    - a = 4/dx² (quadratic) or 3/dx² (cubic).
    - κ = 1 and B = 2a for APIC; κ = 0 and B = 4Ξ for PIC and FLIP, which forget the affine velocity.

    The limit of the semi-implicit step is 1/√(1 − 2β) times that for β < ½. For the other implicit methods there is no
    limit: the result is infinite, and says nothing of accuracy. The left side has further terms (notes/stable_step.md):

    - of loads what each states (`AbstractTerm.stability_rates`), of springs and dashpots to the ground twice what a
      particle by itself feels;
    - in the updated description 2 Δt² α (eq. 35), with α the fastest rate at which the present acceleration strains the
      particle: zero in equilibrium, and large at free surfaces of stretched material;
    - of surfaces that push (`SeparatingBox`, `SeparatingCollider`) n Δt² k (1 + A b²)/m, whether or not anything
      touches, with the stiffness k of a particle that comes with all of its speed (see `SurfaceContact`), and n = 1, or
      2 for a particle between two that face each other: with two particles along a cell's edge the limit falls by a
      quarter, at the speed of sound by two fifths;
    - of `Bodies` Δt² 4 k/(ρ dx²), with the stiffness k of `BodyContact`, whether or not they touch: between bodies of
      one law the limit falls by three tenths. Where they touch, a bound for the present springs takes its place if that
      is more: between two blocks the limit falls by nearly four tenths.

    The default safety of 0.7 covers an effect beyond the linear limit. Vibrations of a few per cent grow where the
    third or fourth harmonic of a mode resonates with the step, (ωΔt)² = 3 and 2, which is at 0.87 and 0.71 of the
    limit: a particle released at a stretch of 1.2 blows up at 0.75 of it, and does not at 0.7.

    *When it breaks*: Δt is constant in a rollout, so compute it at the state of the largest stretch expected. With the
    linear kernel a = 1/(s(1 − s) dx²), with s the place of the particle in its cell: the bound holds only at the
    present positions, and is zero at a face of a cell. A physical instability (buckling) grows at every step.

    Args:
        scene: the scene.
        particles: the particles, prepared if they are not (see `prepare`).
        method: the integrator.
        safety: factor of the bound.
        t1: end time [s]. If given, the result is the longest step within the bound of which t1 is a multiple.
        t: time of the state [s], at which boundaries, loads and body forces act. Default: 0.

    Raises:
        ValueError: from `prepare`; a safety that is not positive; an integrator, transfer, gradient operator or term
            that gives no bound; with t1, a bound that is zero or infinite.
    """
    require_positive("safety", safety, particles.x.dtype)
    limit = canonical(safety, particles.x.dtype) * longest_step(scene, particles, method, t)
    if not is_traced(limit):
        require(
            not np.isnan(limit),
            "stable_dt needs particles whose F is finite and one that their law allows, and an isotropic law.",
        )
    return limit if t1 is None else _whole(limit, t1, type(method).__name__)


def step_for(
    scene: Scene,
    particles: Particles,
    t1: Scalar,
    dt: Scalar | Literal["stable"],
    method: AbstractIntegrator,
    start: int,
) -> Scalar:
    """The step of a run [s]: `dt`, or for "stable" the `stable_dt` of the particles, at step 0 alone."""
    if not isinstance(dt, str):
        return dt
    require(start == 0, 'A run that goes on has the step that it began with: give dt, which run.dt is, not "stable".')
    return stable_dt(scene, particles, method=method, t1=t1)


def _whole(limit: Array, t1: Scalar, method: str) -> Float[Array, ""]:
    """The longest step within a limit of which t1 is a multiple [s]."""
    if is_traced((limit, t1)):
        raise ValueError(
            "The number of steps must be known, and the limit that fixes it is traced here: ask for "
            "stable_dt(scene, particles, t1=t1) outside of the jax transformation, and pass the number."
        )
    require_positive("t1 [s]", t1, limit.dtype)
    bound, end = float(limit), float(t1)
    finite = bound < np.inf
    require(finite, f"{method} has no longest stable step here, so accuracy alone decides: give dt in seconds.")
    require(
        end <= bound * MOST_STEPS,
        f"The longest stable step is {bound:.3g} s, of which t1 = {t1} s takes more than {MOST_STEPS}: choose an "
        "implicit method, a coarser grid or, if the step is zero, another kernel than the linear one.",
    )
    count = max(1, math.ceil(end / bound))
    while end / count > bound:  # by the rounding of the quotient
        count += 1
    return jnp.asarray(end / count, limit.dtype)


def longest_step(scene: Scene, particles: Particles, method: AbstractIntegrator, t: Scalar = 0.0) -> Float[Array, ""]:
    """`stable_dt` with a safety of one [s]; NaN if an F is not finite, or too large.

    Raises:
        UnknownBoundError: an integrator, transfer, gradient operator or term gives no bound.
    """
    scene, method, t = canonical((scene, method, t), particles.x.dtype)
    particles = particles if is_prepared(scene, particles) else prepare(scene, particles)
    if not is_traced(particles.mass) and not np.all(np.asarray(particles.mass)):
        particles = with_dust(particles)
    return _limit(scene, particles, method, t)


@eqx.filter_jit
def _limit(scene: Scene, particles: Particles, method: AbstractIntegrator, t: Scalar) -> Float[Array, ""]:
    factor = method.stability_factor()
    if factor is None:
        raise UnknownBoundError(f"{type(method).__name__} gives no bound on its step: give dt.")
    density, stencil = particles.mass / particles.volume, scene.stencil(particles, t)
    elastic_steepness, viscous_steepness = _steepness(scene, stencil)
    materials = scene.material_points(particles, t)
    stiffest = jnp.concatenate([points.stiffest(scene.grid.strain_dim) for points in materials])
    z, viscous = stiffest * elastic_steepness / density, []  # per Δt²
    for points in materials:  # the largest eigenvalue of ∇v ↦ |J| σ_v [Pa s], in the total description a bound of it
        most = jnp.zeros_like(points.volume)
        if points.viscosity is not None:
            most = jnp.abs(points.volume_ratio()) * points.viscosity.stiffest(scene.grid.strain_dim)
            most = most / (la.principal_frame(points.deformation)[1] ** 2).min(axis=0) if points.total else most
        viscous.append(most)
    y = jnp.concatenate(viscous) * viscous_steepness / density  # per Δt
    if not scene.total:  # in the total description there are no such surfaces, and strains add
        dt = _longest(z, y)  # over which walls move
        nodes = start_nodes(scene, particles, t, jnp.where(jnp.isfinite(dt), dt, 1), stencil)
        # the fastest rate at which the present acceleration a strains each particle: the eigenvalue of the symmetric
        # part of ∇a that is largest in magnitude, or |div a| for a law that knows J alone
        at_rest = ConstrainedNodes(nodes, (), Mirror(()), nodes)
        contacts = [contact for contact in nodes.contacts if contact.known_at_start(nodes)]
        springs = (contact.springs(contact.likely_held(at_rest)) for contact in contacts)
        # springs that are shut already push at the start, and what they accelerate strains the particles
        terms = tuple(spring for spring in springs if spring is not None)
        pushed = nodes.constrained(Mirror(()), nodes.mass, nodes.conditions.fixed, terms)
        a = pushed.projection.combine(pushed.per_mass(pushed.force) + pushed.acceleration, 0.0)
        slopes = nodes.potential.displaced(a).at_particles[1]
        rates, fastest = la.symmetric_eigen((slopes + la.transpose(slopes)) / 2)[0], []
        for law, points in zip(scene.laws, materials, strict=True):
            r = points.rows_of(rates)
            fastest.append(jnp.abs(r).max(axis=0) if law.measure.axes else jnp.abs(r.sum(axis=0)))
        z = z + 2 * jnp.concatenate(fastest)
        bounds = nodes.mass, particles.mass, elastic_steepness
        brought = list(zip(nodes.brought_by, nodes.contacts, strict=True))
        z = z + _contact_rate([contact for number, contact in brought if number is not None], *bounds)
        if scene.bodies is not None:
            felt = _contact_rate([contact for number, contact in brought if number is None], *bounds)
            z = z + jnp.maximum(felt, _between_bodies(scene, particles, materials))
    points = points_of(scene.loads, scene.laws, particles, stencil, total=scene.total)
    for term in terms_of(scene.loads, points, t):
        rates = term.stability_rates(particles.mass, jnp.broadcast_to(elastic_steepness, z.shape))
        if rates is None:
            raise UnknownBoundError(f"{type(term).__name__} gives no bound on the step: give dt.")
        z, y = z + rates[0], y + rates[1]
    return _longest(factor * z, factor * y)


def _longest(z: Array, y: Array) -> Float[Array, ""]:
    """The longest Δt with Δt² z + Δt y ≤ 4 for all particles [s]; infinite where none limits it."""
    z, y = jnp.maximum(z, 0), jnp.maximum(y, 0)
    square = y**2 + 16 * z
    none = square == 0  # and not what is NaN, which the least must keep
    steepness = (y + jnp.where(none, 0, jnp.sqrt(jnp.where(none, 1, square)))).max()
    return jnp.where(steepness == 0, jnp.inf, 8 / jnp.where(steepness == 0, 1, steepness))


def _contact_rate(
    contacts: list[AbstractContact], nodal_mass: NodeScalar, mass: Array, steepness: Array
) -> Array | float:
    """The part of the springs of contacts in Λ A/ρ0 [1/s²] (see `AbstractContact.stability_rate`)."""
    kinds: dict[type[AbstractContact], list[AbstractContact]] = {}
    for contact in contacts:
        kinds.setdefault(type(contact), []).append(contact)
    rates = (kind.stability_rate(tuple(alike), nodal_mass, mass, steepness) for kind, alike in kinds.items())
    return sum(rates, 0.0)


def _between_bodies(scene: Scene, particles: Particles, materials: tuple[MaterialPoints, ...]) -> Float[Array, ""]:
    """The most that the springs between bodies that may meet add to Λ A/ρ0 [1/s²]: 4 k/(ρ dx²), with the stiffness k of
    the two in a row and the density ρ of the lighter. A node at a distance s from the surface has the share
    cos²(πs/2dx) of a spring, and with the masses G(s) and G(−s) of the two bodies that makes at most that."""
    assert scene.bodies is not None
    density, speed = particles.mass / particles.volume, length(particles.v)
    modulus = contact_moduli(scene, particles, materials) + density * (speed + speed.max()) ** 2
    stiff: dict[int, Array] = {}
    light: dict[int, Array] = {}
    for body, points in zip(scene.bodies.numbers(len(scene.laws)), materials, strict=True):
        k, rho = modulus[slice(*points.rows)].max(), density[slice(*points.rows)].min()
        stiff[body], light[body] = jnp.maximum(stiff.get(body, k), k), jnp.minimum(light.get(body, rho), rho)
    pairs = combinations(stiff, 2)
    added = [series_stiffness(stiff[a], stiff[b]) / jnp.minimum(light[a], light[b]) for a, b in pairs]
    return 4 * STIFFNESS * jnp.stack(added).max() / jnp.asarray(scene.grid.spacing) ** 2


def _steepness(scene: Scene, stencil: Stencil) -> tuple[Array, Array]:
    """A and B [1/m²] of the bound Δt² Λ A/ρ0 + Δt Λ_v B/ρ0 ≤ 4 (derivation, eq. 34), from the scene's gradient operator
    and transfer."""
    spacing = jnp.asarray(scene.grid.spacing)
    if scene.kernel.order == 1:
        inverse_moment = 1 / stencil.moment.min(axis=0)
    else:
        inverse_moment = 1 / scene.kernel.variance / spacing**2
    bound = scene.gradient.steepness(scene.kernel, spacing, inverse_moment)
    if scene.total and (bound is None or scene.kernel.order > 1):  # Ξ at each particle; Σ_i g gᵀ/w is diagonal
        touched = stencil.weights > 0
        parts = jnp.where(touched, stencil.weight_derivatives**2 / jnp.where(touched, stencil.weights, 1), 0)
        bound = parts.sum(axis=1).max(axis=0)
    bounds = None if bound is None else scene.transfer.steepness(inverse_moment, bound)
    if bound is None or bounds is None:
        culprit = scene.gradient if bound is None else scene.transfer
        raise UnknownBoundError(f"{type(culprit).__name__} gives no bound on the step: give dt.")
    if stencil.radius is None:
        return bounds
    # a hoop alone has 1/r² < a; before the mirror at the axis, where it strains with ∂u_r/∂r, it adds 1/(D + r²)
    near = stencil.radius < (scene.kernel.order - 1) / 2 * spacing
    hoop = jnp.where(near, 1 / (1 / inverse_moment + stencil.radius**2), 0)
    steeper = scene.transfer.steepness(inverse_moment + hoop, bound + hoop)
    assert steeper is not None
    return steeper[0], bounds[1] + 4 * hoop
