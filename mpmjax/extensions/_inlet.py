"""Controls by which particles enter and leave: nozzles, outflows, excavations."""

from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Point, Scalar, components
from mpmjax.checks import coordinates, positive, require, require_fields, require_that
from mpmjax.geometry import AbstractRegion, HalfSpace, Motion
from mpmjax.state import Particles, Scene


def placed(scene: Scene, particles: Particles, chosen: Bool[Array, "p"], **new: Array) -> Particles:
    """Prepared particles, of which the `chosen` ones have a `new` x, v, mass and volume, move as one, and were never
    deformed."""
    require(not scene.total, "Particles enter and leave in the updated description only: drop TotalLagrangian().")
    require(not scene.grid.follow, "Particles enter and leave where the window rests: drop follow=True of the grid.")

    def put(new: Any, old: Array, rows: slice = slice(None)) -> Array:
        return jnp.where(chosen[rows].reshape(-1, *[1] * (old.ndim - 1)), new, old)

    deformations, histories = [], []
    for law, group in zip(scene.laws, particles.groups, strict=True):
        rows, old = group.rows, jnp.asarray(group.stored)
        none = law.measure.undeformed(scene.grid.strain_dim)
        rest = jnp.broadcast_to(jnp.asarray(none, old.dtype), old.shape)
        fresh = law.initial_history(components(rest))
        deformations.append(put(rest, old, rows))
        histories.append(jax.tree.map(lambda new, old, rows=rows: put(new, old, rows), fresh, group.history))
    C = None if particles.C is None else put(0, particles.C)
    rows = {name: put(values, getattr(particles, name)) for name, values in new.items()}
    return replace(particles, C=C, deformations=tuple(deformations), histories=tuple(histories), **rows)


class Inlet(eqx.Module):
    """A control: material that is pushed through a nozzle with a velocity, and is free beyond its gate.

    The stock, all that will ever enter, stands upstream of the gate and moves as one rigid body. What of it is within
    `length` before the gate fills the nozzle; what is further back waits at its rear without mass; what has passed the
    gate moves by itself. Mass enters as ρ v A. What follows is differentiable by the velocity, as long as in each step
    the same particles have passed the gate.

        jet = mpm.fill(mpm.Box((-1.9, 0.4), (0.1, 0.5)), grid, density=1e3)
        inlet = mpm.extensions.Inlet(jet, (1.0, 0.0), gate=mpm.HalfSpace((0.1, 0.0), (1.0, 0.0)), length=0.1)
        run = mpm.simulate(scene, inlet.particles(), t1=1.0, dt=1e-3, control=inlet)

    *When it breaks*: the total description and a window that follows are refused. What is free and comes into the
    nozzle from outside is carried along. In the nozzle nothing is compressed or slowed: if it is blocked it presses
    without bound. `stable_dt` knows the density of what is there: of a material that is yet to come ask with the stock.

    *Good values*: a length of three spacings or more: what enters the nozzle then shares no node with what has left.

    Args:
        stock: all particles that enter, as `fill` makes them, where they are at t = 0; the grid need not reach them.
        velocity: [m/s], (d,), from t = 0; or a `Motion`. It never leads back.
        gate: the half-space of the nozzle, its normal downstream; the grid reaches `length` behind it.
        length: of the nozzle [m].
        first: the number of the first particle of the stock among those of the scene. Default: 0.
    """

    stock: Particles
    velocity: Point | Motion
    gate: HalfSpace
    length: Annotated[Scalar, positive, "m"]
    first: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        require_fields(self)
        d, motion = self.gate.dim, self.velocity
        size = motion.dim if isinstance(motion, Motion) else coordinates("An Inlet's velocity", motion)
        require(
            size == d == self.stock.dim,
            f"An Inlet's stock, velocity and gate must have as many coordinates, got {self.stock.dim}, {size}, {d}.",
        )
        along = [motion] if not isinstance(motion, Motion) else jnp.diff(jnp.asarray(motion.displacement), axis=0)
        for step in along:
            require_that(
                "An Inlet's velocity must not lead back from its gate",
                lambda *a: sum(b * c for b, c in zip(a[:d], a[d:], strict=True)) >= 0,
                *step,
                *self.gate.normal,
            )

    def _pushed(self, t: Scalar) -> tuple[dict[str, Array], Bool[Array, "q"]]:
        """x, v, mass and volume of the stock at time t, what waits at the rear without mass; and whether each has left
        the nozzle."""
        start = jnp.asarray(self.stock.x)
        t = jnp.asarray(t, start.dtype)

        def shift(t: Array) -> Array:
            motion = self.velocity
            return motion.at(t) if isinstance(motion, Motion) else t * jnp.asarray(motion, start.dtype)

        moved, v = jax.jvp(shift, (t,), (jnp.ones_like(t),))
        x = start + moved
        beyond, normal = self.gate.distance(x), jnp.asarray(self.gate.normal, x.dtype)
        behind = jnp.minimum(beyond + jnp.asarray(self.length, x.dtype), 0)
        rear = x - behind[:, None] * normal / jnp.linalg.norm(normal)
        mass, volume = (jnp.where(behind == 0, a, 0) for a in (self.stock.mass, self.stock.volume))
        return {"x": rear, "v": jnp.broadcast_to(v, x.shape), "mass": mass, "volume": volume}, beyond > 0

    def entered(self, t: Scalar) -> Float[Array, ""]:
        """The mass that has come into the nozzle by time t [kg], from the start on."""
        return self._pushed(t)[0]["mass"].sum()

    def particles(self) -> Particles:
        """The stock as it stands at t = 0, to begin a run with, alone or joined to others."""
        return replace(self.stock, **self._pushed(0.0)[0])

    def __call__(
        self, scene: Scene, particles: Particles, t: Scalar, dt: Scalar, memory: Any
    ) -> tuple[Scene, Particles, Any]:
        """The particles with the stock where it is at time t."""
        require(
            self.first + self.stock.count <= particles.count,
            f"An Inlet's stock of {self.stock.count} particles from number {self.first} on must be among the "
            f"{particles.count} of the run: join inlet.particles() to the others, and give its `first`.",
        )
        rows = slice(self.first, self.first + self.stock.count)
        pushed, free = self._pushed(t)
        new = {name: getattr(particles, name).at[rows].set(values) for name, values in pushed.items()}
        held = jnp.zeros(particles.count, bool).at[rows].set(~free)
        return scene, placed(scene, particles, held, **new), memory


class Outlet(eqx.Module):
    """A control: what comes into a region, or lies in it from some time on, is taken away: an outflow, an excavation.

    Particles that are taken have no mass from then on, and rest at a place in the grid.

    *When it breaks*: the total description and a window that follows are refused. What is taken under stress is gone
    from one step to the next: the rest rebounds.

    Args:
        region: the region.
        start: the time from which it takes [s]. Default: always.
        rest: where particles without mass are kept [m], (d,), within the grid's window. Default: the region's middle.
    """

    region: AbstractRegion
    start: Scalar = float("-inf")
    rest: Point | None = None

    def __check_init__(self):
        require_fields(self)
        fits = self.rest is None or coordinates("An Outlet's rest", self.rest) == self.region.dim
        require(fits, f"An Outlet's rest must have {self.region.dim} coordinates, as its region, got {self.rest}.")

    def __call__(
        self, scene: Scene, particles: Particles, t: Scalar, dt: Scalar, memory: Any
    ) -> tuple[Scene, Particles, Any]:
        """The particles without mass where they are taken."""
        x, d = particles.x, self.region.dim
        require(d == particles.dim, f"An Outlet's region must have {particles.dim} coordinates, as the run, got {d}.")
        taken = (self.region.contains(x) & (t >= self.start)) | (particles.mass == 0)
        none = jnp.zeros_like(particles.mass)
        rest = jnp.asarray(self.region.middle() if self.rest is None else self.rest, x.dtype)
        rest = jnp.broadcast_to(rest, x.shape)
        kept = placed(scene, particles, taken, x=rest, v=jnp.zeros_like(x), mass=none, volume=none)
        return scene, kept, memory


class Controls(eqx.Module):
    """Several controls as one, each after the one before it. Their memory is a tuple with one entry each.

    Args:
        parts: the controls.
    """

    parts: tuple[Any, ...]

    def __check_init__(self):
        functions = isinstance(self.parts, tuple) and len(self.parts) > 0 and all(map(callable, self.parts))
        require(functions, "Controls takes a tuple of functions, each a control, got something else or none.")

    def __call__(
        self, scene: Scene, particles: Particles, t: Scalar, dt: Scalar, memory: Any
    ) -> tuple[Scene, Particles, Any]:
        """Scene, particles and memory after all of them."""
        memories = (None,) * len(self.parts) if memory is None else memory
        after = []
        for part, remembered in zip(self.parts, memories, strict=True):
            scene, particles, remembered = part(scene, particles, t, dt, remembered)
            after.append(remembered)
        return scene, particles, None if memory is None else tuple(after)
