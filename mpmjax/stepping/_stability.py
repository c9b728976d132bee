"""The longest stable step."""

import math
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import canonical, checked, is_traced, require, require_positive
from mpmjax.discretisation import Stencil
from mpmjax.state import MaterialPoints, Particles, Scene, is_prepared, prepare
from mpmjax.stepping._explicit import Explicit
from mpmjax.stepping._integrator import AbstractIntegrator

MOST_STEPS = 2**31 - 1
"""The largest number of steps of a run."""
SAFETY = 0.7
"""The default safety."""


class UnknownBoundError(ValueError):
    """An integrator, transfer or gradient operator gives no bound on the step."""


@checked
def stable_dt(
    scene: Scene,
    particles: Particles,
    *,
    method: AbstractIntegrator = Explicit(),
    safety: Scalar = SAFETY,
    t1: Scalar | None = None,
) -> Float[Array, ""]:
    """The longest step Δt [s] for which the motion about the particles' present state does not grow.

    For each particle alone on the grid the step's limit is known exactly, and no assembly of particles has a lower one
    than the lowest of its members (B. M. Irons, G. Treharne, Proc. 3rd Conf. on Matrix Methods in Structural Mechanics,
    1971, for frequencies; for the step of APIC and PIC the same argument holds with the velocity that the transfer
    keeps): Δt² = 4 ρ0 / (Λ (2Ξ − κa)), the least over particles, with

    - Λ the largest eigenvalue of the present tangent L ↦ ∂²Ψ/∂F∂F : (L F) Fᵀ + τ Lᵀ, L = ∇v, τ = P Fᵀ, made symmetric,
      from `principal_tangent` (in the total description that of ∂²Ψ/∂F∂F): stretching and compression raise it;
    - Ξ a bound of Σ_i g_ip g_ipᵀ/w_ip: a for the moving-least-squares gradient; for the spline's its value where the
      particle is in the total description, and in the updated one, since particles move, at the worst place in a cell,
      6/dx² (quadratic) and 3.137/dx² (cubic);
    - a = 4/dx² (quadratic), 3/dx² (cubic); κ = 1 for APIC and 0 for PIC and FLIP, which forget the affine velocity.

    At F = I that is √(4ρ0/((2μ + dλ)(2Ξ − κa))). The semi-implicit step's is 1/√(1 − 2β) times it for β < ½; for
    β ≥ ½, for backward Euler and for the methods of second order there is none: the result is infinite, and says
    nothing of accuracy.

    With viscosity it is Δt of Δt² Λ (2Ξ − κa)/ρ0 + Δt Λ_v b/ρ0 = 4, Λ_v the largest eigenvalue of L ↦ |J| σ_v, that is
    |J| max(2η, 2η (1 − d/3) + dζ), and b = 2a for APIC, whose stored gradient a step multiplies by 1 − Δt a Λ_v/ρ0, or
    4Ξ for PIC and FLIP, whose gradient of a step ago stands beside nothing that it changes; 8/(B + √(B² + 16A)) with
    the factors A of Δt² and B of Δt. The semi-implicit step has (1 − 2β) times both.

    The default safety of 0.7 is for what is not linear. Vibrations of a few per cent grow below the linear limit where
    a mode's third or fourth harmonic resonates with the step, (ωΔt)² = 3 and 2, at 0.87 and 0.71 of the limit: a
    particle released at a stretch of 1.2 blows up at 0.75 of it, and does not at 0.7. It also covers what the argument
    leaves out in the updated description, the motion of stencils under stress: among random clouds in which stretches
    of 0.6 and 1.6 are neighbours the linearised step fails down to 0.94 of the bound.

    *When it breaks*: Δt must be constant in a rollout, so ask for it at the state of the largest stretch expected. With
    the linear kernel a = 1/(s(1 − s) dx²), s the particle's place in the cell, so that the bound holds only where the
    particles are now and is zero at a cell's face. No step makes a physical instability (buckling) go away.

    Args:
        scene: the scene.
        particles: the particles; what the scene needs and they lack is added.
        method: update of the grid velocity.
        safety: factor of the bound.
        t1: end time [s]: the result is then the longest step at or below the bound of which t1 is a whole number.

    Raises:
        ValueError: from `prepare`; a safety that is not positive; an integrator, transfer or gradient operator that
            gives no bound; with t1, a bound that is zero or infinite.
    """
    require_positive("safety", safety)
    limit = canonical(safety, particles.x.dtype) * longest_step(scene, particles, method)
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
    """The step that is asked for [s]: a number, or `stable_dt` of the particles as they start.

    Raises:
        ValueError: of `stable_dt`; "stable" for a run that does not start at step 0.
    """
    if not isinstance(dt, str):
        return dt
    require(start == 0, 'A run that goes on has the step that it began with: give dt, which run.dt is, not "stable".')
    return stable_dt(scene, particles, method=method, t1=t1)


def _whole(limit: Array, t1: Scalar, method: str) -> Float[Array, ""]:
    """The longest step at or below a limit of which t1 is a whole number [s]."""
    if is_traced((limit, t1)):
        raise ValueError(
            "The number of steps must be known, and the limit that fixes it is traced here: ask for "
            "stable_dt(scene, particles, t1=t1) outside of the jax transformation, and pass the number."
        )
    require_positive("t1 [s]", t1)
    bound, end = float(limit), float(t1)
    require(
        bound < np.inf,
        f"{method} has no longest stable step here, so accuracy alone decides: give dt as a number of seconds.",
    )
    require(
        end <= bound * MOST_STEPS,
        f"The longest stable step is {bound:.3g} s, of which t1 = {t1} s takes more than {MOST_STEPS}: choose an "
        "implicit method, a coarser grid or, if the step is zero, another kernel than the linear one.",
    )
    count = max(1, math.ceil(end / bound))
    while end / count > bound:  # by the rounding of the quotient
        count += 1
    return jnp.asarray(end / count, limit.dtype)


def longest_step(scene: Scene, particles: Particles, method: AbstractIntegrator) -> Float[Array, ""]:
    """`stable_dt` with a safety of one [s]; NaN where F is not finite, or too large.

    Raises:
        UnknownBoundError: an integrator, transfer or gradient operator gives no bound.
    """
    scene, method = canonical((scene, method), particles.x.dtype)
    return _limit(scene, particles if is_prepared(scene, particles) else prepare(scene, particles), method)


@eqx.filter_jit
def _limit(scene: Scene, particles: Particles, method: AbstractIntegrator) -> Float[Array, ""]:
    density = particles.mass / particles.volume
    elastic_steepness, viscous_steepness = _steepness(scene, particles)
    bodies = scene.material_points(particles)
    tangents = [c.law.tangent_eigenvalues(c.deformation, particles.dim, total=c.total) for c in bodies]
    stiffest = jnp.concatenate([values.max(axis=0) for values in tangents])
    z = stiffest * elastic_steepness / density  # per Δt²
    factor = method.stability_factor()
    if factor is None:
        raise UnknownBoundError(f"{type(method).__name__} gives no bound on its step: give dt.")
    most = jnp.concatenate([_stiffest_viscosity(c, particles.dim) for c in bodies])
    y = most * viscous_steepness / density  # per Δt
    z, y = jnp.maximum(factor * z, 0), jnp.maximum(factor * y, 0)
    square = y**2 + 16 * z
    none = square == 0  # and not what is NaN, which the least must keep
    steepness = (y + jnp.where(none, 0, jnp.sqrt(jnp.where(none, 1, square)))).max()
    return jnp.where(steepness == 0, jnp.inf, 8 / jnp.where(steepness == 0, 1, steepness))


def _stiffest_viscosity(body: MaterialPoints, dim: int) -> Float[Array, "q"]:
    """The largest eigenvalue of each particle's ∇v ↦ |J| σ_v [Pa s]; in the total description a bound of it."""
    J = jnp.abs(body.volume_ratio())
    if body.viscosity is None:
        return jnp.zeros_like(J)
    most = J * body.viscosity.stiffest(dim)
    return most / (la.principal_frame(body.deformation)[1] ** 2).min(axis=0) if body.total else most


def _steepness(scene: Scene, particles: Particles) -> tuple[Array, Array]:
    """A and B [1/m²] of Δt² Λ A/ρ0 + Δt Λ_v B/ρ0 ≤ 4, by the scene's gradient operator and transfer."""
    spacing = jnp.asarray(scene.grid.spacing)
    if scene.kernel.order == 1:
        inverse_moment = 1 / scene.stencil(particles).moment.min(axis=0)
    else:
        inverse_moment = 1 / scene.kernel.variance / spacing**2
    bound = scene.gradient.steepness(scene.kernel, spacing, inverse_moment)
    if scene.total and (bound is None or scene.kernel.order > 1):
        bound = _steepness_here(scene.stencil(particles))
    bounds = None if bound is None else scene.transfer.steepness(inverse_moment, bound)
    if bound is None or bounds is None:
        culprit = scene.gradient if bound is None else scene.transfer
        raise UnknownBoundError(f"{type(culprit).__name__} gives no bound on the step: give dt.")
    return bounds


def _steepness_here(stencil: Stencil) -> Float[Array, "p"]:
    """Ξ [1/m²] where each particle is, shape (p,): Σ_i g_ip g_ipᵀ/w_ip is diagonal."""
    touched = stencil.weights > 0
    parts = jnp.where(touched, stencil.weight_derivatives**2 / jnp.where(touched, stencil.weights, 1), 0)
    return parts.sum(axis=1).max(axis=0)
