"""A correction by which what flows sees how densely its particles lie."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, NodeScalar, ParticleScalar, Scalar
from mpmjax.checks import positive, require, require_fields
from mpmjax.discretisation import Grid, Stencil, gather, scatter
from mpmjax.geometry import AbstractRegion, length
from mpmjax.state import AbstractCorrection, Particles, Scene

LEAST_DENSITY = 1e-3  # φ that counts at least: what has no mass divides by none
LEAST_SHARE = 0.02  # of a node's kernel within the room, at least: what a particle on a wall on nodes needs


class DensityCorrection(AbstractCorrection):
    """Compress a fluid where its particles crowd, so that it keeps its level when it splashes.

    J of a particle is the product of its steps' changes. In a mixing flow particles crowd whose J are right, and water
    sinks into itself. Here the density φ by the grid, in the room that there is, holds J at the start of each step:

        φ_p = Σ_i w_ip (S V)_i / (S s dx^d)_i,    V_i = Σ_q w_iq V0_q,
        J_p ← J_p + (1 − e^{−rate γ̇_p Δt}) min((1 + slack) / φ_p − J_p, 0),

    s_i the share of the kernel of node i in the room; of other materials J V0 counts. S takes half of a node and a
    quarter of each neighbour along each axis: particles up to two and a half spacings apart then do not seem to crowd.
    The shear rate γ̇ = √(2 D:D) makes it one of strain: what rests stays as it is. (After the density that T.
    Kugelstadt, A. Longva, N. Thuerey and J. Bender project on the grid, IEEE Trans. Vis. Comput. Graph. 27(4) (2021);
    here by the fluid's own pressure.)

        vessel = mpm.Box((0.0, 0.0), (1.0, 3.0))
        scene = mpm.Scene(..., mpm.Fluid(2e5), correction=mpm.extensions.DensityCorrection(vessel))

    *When it breaks*: material that parts gains the energy of the pressure that parts it. Beside walls that `room` does
    not name, layers may hold 1.7 times what fits. A fluid that is no `Fluid` and stores F is not corrected.

    *Good values*: the defaults: a dam that breaks keeps its level within 3 %, where with two particles along a cell it
    loses 20 %, and half of it at five times the explicit limit (`python benchmarks/audit.py --only splash`).

    Args:
        room: the region that material may fill; it does not move. Default: everywhere.
        rate: how much of the excess a shear strain of one takes away, as an exponent [-].
        slack: the excess of density that stays [-]: as much as irregular particles have by chance.
    """

    room: AbstractRegion | None = None
    rate: Annotated[Scalar, positive] = 3.0
    slack: Annotated[Scalar, positive] = 0.02
    __check_init__ = require_fields

    def check(self, scene: Scene) -> None:
        flows = any(law.measure.axes == 0 for law in scene.laws)
        require(flows, "DensityCorrection is for fluids that store J, such as Fluid: the scene has none.")
        require(scene.keeps_gradient, "DensityCorrection reads the velocity gradient C: take the transfer APIC().")
        require(scene.bodies is None, "DensityCorrection takes one density at each node: drop bodies or it.")
        d, room = scene.grid.dim, self.room
        require(room is None or room.dim == d, f"DensityCorrection's room must have {d} coordinates, as the grid.")

    def density(self, scene: Scene, particles: Particles, stencil: Stencil, t: Scalar = 0.0) -> ParticleScalar:
        """φ of prepared particles [-], shape (p,), from their stencil at time t [s]."""
        taken = [J if q.stored.ndim > 1 else jnp.ones_like(J) for q in particles.groups for J in [q.volume_ratio()]]
        grid = scene.grid
        volume = grid.section(particles.x, particles.volume) * jnp.concatenate(taken)
        held = _smoothed(scatter(stencil, volume[None], None, grid.size)[:, 0], grid)
        room = grid.spacing**grid.dim * _smoothed(self._share(scene, particles, t), grid)
        return gather(stencil, (held / room)[:, None])[0][0]

    def _share(self, scene: Scene, particles: Particles, t: Scalar) -> NodeScalar:
        """s of each node: the quadratic kernel's integral up to each of the room's sides, as if it were flat."""
        if self.room is None:
            return jnp.ones(scene.grid.size, particles.x.dtype)
        s = jnp.clip(-self.room.sides(scene.nodes(particles, t)) / scene.grid.spacing, -1.5, 1.5)
        tail = (1.5 - jnp.abs(s)) ** 3 / 6
        behind = jnp.where(jnp.abs(s) < 0.5, 0.5 + 0.75 * s - s**3 / 3, jnp.where(s > 0, 1 - tail, tail))
        return jnp.maximum(self.room.joined(behind), LEAST_SHARE)

    def corrected(self, scene: Scene, particles: Particles, stencil: Stencil, t: Scalar, dt: Scalar) -> Particles:
        phi, C = jnp.maximum(self.density(scene, particles, stencil, t), LEAST_DENSITY), particles.C
        assert C is not None
        shear_rate = length((C + jnp.swapaxes(C, 1, 2)).reshape(particles.count, -1)) / 2**0.5
        done = -jnp.expm1(-self.rate * dt * shear_rate)

        def compressed(J: Array, rows: slice) -> Array:
            return J + done[rows] * jnp.minimum((1 + self.slack) / phi[rows] - J, 0)

        new = tuple(compressed(q.stored, q.rows) if q.stored.ndim == 1 else q.stored for q in particles.groups)
        return eqx.tree_at(lambda q: q.deformations, particles, new)


def _smoothed(field: NodeScalar, grid: Grid) -> NodeScalar:
    """S of a field of the nodes."""
    at = field.reshape(grid.shape)
    for axis in range(grid.dim):
        at = at / 2 + (jnp.roll(at, 1, axis) + jnp.roll(at, -1, axis)) / 4
    return at.reshape(-1)
