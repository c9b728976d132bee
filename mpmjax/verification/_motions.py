"""Problems whose motion is known: of boxes, bars, rings, vortices and waves; a bent bar; the collision of two disks."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.boundary import AbstractBoundary, Conditions, SlipBox, SymmetryPlane
from mpmjax.checks import require
from mpmjax.discretisation import Grid
from mpmjax.geometry import Annulus, Ball, Box, HalfSpace
from mpmjax.implicit import ConjugateResidual
from mpmjax.material import AbstractMaterial, FixedCorotated, NeoHookean
from mpmjax.state import Couple, Particles, Patch, Scene, TotalLagrangian, attach, fill
from mpmjax.stepping import SemiImplicit, step
from mpmjax.verification._exact_problem import AbstractProblem, Ends, box_boundary

_PHASES = {1: (0.0,), 2: (0.0, 1.0), 3: (0.0, 2 / 3, 4 / 3)}  # of π


class AxisAligned(AbstractProblem):
    """u_i = A sin(πX_i) sin(πct + φ_i) on the unit box, c² = E/ρ0 (M. Steffen, P. C. Wallstedt, J. E. Guilkey,
    R. M. Kirby, M. Berzins, Comput. Model. Eng. Sci. 31 (2008) 107).

    φ = (0, π) in 2-D, (0, 2π/3, 4π/3) in 3-D. The motion is odd at the faces, so it is periodic over [−1, 1]^d.
    """

    amplitude: float = 0.05  # A [m], below 1/π; 0.05 deforms by up to 16 per cent
    dim: int = eqx.field(static=True, default=2)  # space dimension
    ends: Ends = eqx.field(static=True, default=Ends.PERIODIC)  # boundary at the faces
    material: AbstractMaterial = NeoHookean(1e7, 0.3)  # any law; its Young's modulus sets c
    density: float = 1e3  # ρ0 [kg/m^d]

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        phase = jnp.pi * jnp.asarray(_PHASES[self.dim], X.dtype)
        return X + self.amplitude * jnp.sin(jnp.pi * X) * jnp.sin(jnp.pi * self.bar_speed * t + phase)

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        return ((-1.0 if self.ends is Ends.PERIODIC else 0.0),) * self.dim, (1.0,) * self.dim, self.ends

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return box_boundary(*self.box())


class VibratingBar(AbstractProblem):
    """v = v0 cos(ωt) sin(βX), β = (2n − 1)π/2L, ω = β√(E/ρ0), on 0 ≤ X ≤ L.

    Exact at any amplitude in one dimension with ν = 0, where P = E (F − 1) is linear. The free end needs no condition.
    """

    forced: ClassVar[bool] = False
    speed: float = 0.1  # v0 [m/s]
    mode: int = eqx.field(static=True, default=1)  # n, from 1
    length: float = eqx.field(static=True, default=25.0)  # length L of the bar [m]
    material: AbstractMaterial = FixedCorotated(100.0, 0.0)  # the law, with ν = 0
    density: float = 1.0  # ρ0 [kg/m^d]
    dim: int = eqx.field(static=True, default=1)  # space dimension

    @property
    def wave_number(self) -> float:
        """β [1/m]."""
        return (2 * self.mode - 1) * math.pi / (2 * self.length)

    @property
    def frequency(self) -> float:
        """ω [1/s]."""
        return self.wave_number * self.wave_speed

    @property
    def duration(self) -> float:
        """One period [s]."""
        return 2 * math.pi / self.frequency

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        omega = self.frequency
        return X + self.speed / omega * jnp.sin(omega * t) * jnp.sin(self.wave_number * X)

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        return (0.0,), (self.length,), Ends.MIRRORED

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        """Fixed at X = 0."""
        return (SymmetryPlane(0, 0.0),)


class ExpandingRing(AbstractProblem):
    """x = X (1 + A sin(πct) U(R)/R), c² = E/ρ0, on Ri ≤ R ≤ Ro, with
    U = (6 Ri Ro R − 3 (Ri + Ro) R² + 2 R³) / (Ri² (3 Ro − Ri)) (radii and conditions of the expanding ring of
    P. C. Wallstedt, J. E. Guilkey, J. Comput. Phys. 227 (2008) 9628, doi 10.1016/j.jcp.2008.07.019).

    The displacement of the inner edge is A sin(πct). U′ vanishes at both edges, so that with ν = 0 they are free of
    traction at every amplitude. The grid has no part in the shape.
    """

    amplitude: float = 0.1  # A [m], below Ri
    inner: float = 0.4  # Ri [m]
    outer: float = 0.6  # Ro [m]
    material: AbstractMaterial = NeoHookean(1e7, 0.0)  # ν = 0, its radial stress zero at a radial stretch of one
    density: float = 1e3  # ρ0 [kg/m²]
    dim: int = eqx.field(static=True, default=2)  # space dimension

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        a, b = self.inner, self.outer
        R = jnp.sqrt((X**2).sum())
        over = (6 * a * b - 3 * (a + b) * R + 2 * R**2) / (a**2 * (3 * b - a))
        return X * (1 + self.amplitude * jnp.sin(jnp.pi * self.bar_speed * t) * over)

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        return (-1.0,) * 2, (1.0,) * 2, Ends.PLAIN

    def body(self, cells: int) -> Annulus:
        return Annulus((0.0, 0.0), self.inner, self.outer)


_VORTEX_RING = Annulus((0.0, 0.0), 0.75, 1.25)


class RestOutside(AbstractBoundary):
    """A boundary that holds nodes outside of the ring at rest, as the exact motion is at its edges."""

    @property
    def dim(self) -> int:
        return 2

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        outside = _VORTEX_RING.distance(nodes)[:, None] >= 0
        return Conditions(jnp.broadcast_to(outside, nodes.shape), jnp.zeros_like(nodes))


class Vortex(AbstractProblem):
    """x = Q(g h) X, a rotation by g(t) h(R), g = A sin(πt), h = 1 − 32(R−1)² + 256(R−1)⁴ (K. Kamojjala, R. Brannon,
    A. Sadeghirad, J. Guilkey, Eng. Comput. 31 (2015) 201, doi 10.1007/s00366-013-0342-x).

    The volume does not change, and the edges of the ring are at rest.
    """

    amplitude: float = 0.1  # A [rad]; the shear of F reaches 7 A in the ring
    material: AbstractMaterial = NeoHookean(1e3, 0.3)  # any law
    density: float = 1e3  # ρ0 [kg/m²]
    dim: int = eqx.field(static=True, default=2)  # space dimension

    @property
    def duration(self) -> float:
        """Duration of the run [s], the time of a turn and its return."""
        return 1.0

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        s = (jnp.sqrt((X**2).sum()) - 1) ** 2
        turn = self.amplitude * jnp.sin(jnp.pi * t) * (1 - 32 * s + 256 * s**2)
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        return jnp.stack([cos * X[0] - sin * X[1], sin * X[0] + cos * X[1]])

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        return (-1.5,) * 2, (1.5,) * 2, Ends.PLAIN

    def body(self, cells: int) -> Annulus:
        return _VORTEX_RING

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return (RestOutside(),)


_ACROSS = 4  # cells


class StandingWave(AbstractProblem):
    """u₁ = A sin(πX₁) cos(πct) on 0 ≤ X₁ ≤ 1, c² = (λ + 2μ)/ρ0, without any force.

    Exact at every amplitude with F₁₁ > 0: under uniaxial strain fixed corotated elasticity has
    P₁₁ = (λ + 2μ)(F₁₁ − 1), and no coupling to other directions. In these the body is periodic over four cells.
    """

    forced: ClassVar[bool] = False
    amplitude: float = 0.05  # A [m], below 1/π
    dim: int = eqx.field(static=True, default=1)  # space dimension
    ends: Ends = eqx.field(static=True, default=Ends.MIRRORED)  # boundary at X₁ = 0 and 1
    material: AbstractMaterial = FixedCorotated(1e4, 0.3)  # the law, fixed corotated
    density: float = 1e3  # ρ0 [kg/m^d]

    def __check_init__(self):
        require(isinstance(self.material, FixedCorotated), "The standing wave is exact for FixedCorotated only.")
        require(abs(self.amplitude) < 1 / math.pi, f"The amplitude must be below 1/π, got {self.amplitude}.")

    @property
    def duration(self) -> float:
        """Half a period [s]."""
        return 1 / self.wave_speed

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        law: Any = self.material
        c = jnp.sqrt(jnp.asarray(law.lame_lambda + 2 * law.shear_modulus) / self.density)
        return X.at[0].add(self.amplitude * jnp.sin(jnp.pi * X[0]) * jnp.cos(jnp.pi * c * t))

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        """In the first direction."""
        return ((-1.0 if self.ends is Ends.PERIODIC else 0.0),), (1.0,), self.ends

    def grid(self, cells: int) -> Grid:
        along, across = super().grid(cells), self.dim - 1
        shape, origin = (*along.shape, *(_ACROSS,) * across), (*along.origin, *(0,) * across)
        return Grid(shape, along.spacing, origin=origin, periodic=(*along.periodic, *(True,) * across))

    def body(self, cells: int) -> Box:
        (low, high, _), across = self.box(), self.dim - 1
        return Box((*low, *(0.0,) * across), (*high, *(_ACROSS / cells,) * across))

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        if self.ends is Ends.PLAIN:
            across = (math.inf,) * (self.dim - 1)
            return (SlipBox((0.0, *(-a for a in across)), (1.0, *across)),)
        return box_boundary(*self.box())


class BentBar(eqx.Module):
    """A bar 0 ≤ X ≤ L of height and depth one, held at X = 0 and bent by a couple at its other end, at rest.

    With ν = 0 and a small curvature κ, u = κ (−X Y, X²/2), with the stress −E κ Y along it: the face that is held is
    the plane X = 0, without any stress that singles out its corners.
    """

    length: float = 2.0  # L [m]
    curvature: float = 1e-5  # κ [1/m], so small that squares do not matter
    material: AbstractMaterial = FixedCorotated(1e5, 0.0)  # a law with ν = 0

    def errors(self, cells: int, held: AbstractBoundary, **choices: Any) -> tuple[float, float]:
        """The relative errors of the displacement (RMS) and of the stress along the bar (mean, over the largest), with
        `cells` grid cells over the height, what holds it, and choices of kernel and gradient."""
        law: Any = self.material
        L, stiffness = self.length, self.curvature * law.youngs_modulus
        grid = Grid((math.ceil(L * cells) + 9, 2 * math.ceil(cells / 2) + 9), 1 / cells, origin=(-4, -4 - cells // 2))
        bar = fill(Box((0.0, -0.5), (L, 0.5)), grid, density=1.0)
        end = Patch(HalfSpace((L, 0.0), (-1.0, 0.0)), Box((L - 0.1, -0.5), (L + 0.1, 0.5)))
        choices = {"boundary": held, "loads": Couple(end, stiffness / 12), "description": TotalLagrangian()} | choices
        scene = attach(Scene(grid, law, **choices), bar)
        tight = SemiImplicit(solver=ConjugateResidual(rtol=1e-10, max_steps=20_000))
        after = step(scene, bar, 0.0, 1e6 * L / law.youngs_modulus**0.5, method=tight)[0]
        X, Y = bar.x.T
        exact = self.curvature * jnp.stack([-X * Y, X**2 / 2], axis=1)
        stress = jax.vmap(law.stress)(after.F)[:, 0, 0]
        u = jnp.sqrt(((after.x - bar.x - exact) ** 2).sum() / (exact**2).sum())
        return float(u), float(jnp.abs(stress + stiffness * Y).mean() / (stiffness / 2))


class TwoDisks(eqx.Module):
    """Two disks that move along a diagonal, collide and part (the scene of D. Sulsky, Z. Chen, H. L. Schreyer, Comput.
    Methods Appl. Mech. Eng. 118 (1994) 179, doi 10.1016/0045-7825(94)90112-0).

    No exact motion is known. The momentum is zero at all times, the disks touch at t = (‖Δcentre‖ − 2R)/‖Δv‖, and the
    energy never grows.
    """

    radius: float = 0.2  # R [m]
    centre: float = 0.3  # the centres of the disks are ±(centre, centre) [m]
    speed: float = 0.1  # their initial velocities are ∓(speed, speed) [m/s]
    density: float = 1e3  # ρ0 [kg/m²]
    material: AbstractMaterial = NeoHookean(1e3, 0.3)  # the law of both

    @property
    def contact_time(self) -> float:
        """Time at which the circles touch [s]."""
        return (2**0.5 * self.centre - self.radius) / (2**0.5 * self.speed)

    def discretise(
        self, cells: int = 20, *, per_side: int = 2, fitted: bool = False, **choices: Any
    ) -> tuple[Scene, Particles]:
        """Scene and particles, with `cells` grid cells to a metre and `per_side` particles to the side of a cell,
        `fitted` to the circles or not (see `fill`), and choices of kernel, gradient and transfer."""
        half = round(0.75 * cells)
        grid = Grid((2 * half + 1,) * 2, 1 / cells, origin=(-half,) * 2)
        alike: Any = {"particles_per_cell": per_side**2, "density": self.density, "fitted": fitted}
        balls = [(Ball((side * self.centre,) * 2, self.radius), (-side * self.speed,) * 2) for side in (-1, 1)]
        disks = [fill(ball, grid, velocity=velocity, **alike) for ball, velocity in balls]
        return Scene(grid, self.material, **choices), jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *disks)
