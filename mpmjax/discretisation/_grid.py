"""The background grid: a window of static shape on an unbounded lattice, placed by its integer origin."""

import math
from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Int, NodeVector, ParticleVector, Scalar
from mpmjax.checks import between, checked, positive, require, require_fields, whole

_MOST_NODES = 2**31  # what an index of 32 bits counts
_Spacing = Annotated[Scalar, positive, "m"]


class Grid(eqx.Module):
    """A uniform Cartesian grid of nodes at (origin + index) * spacing.

    It is a window on an unbounded lattice. A node quantity is an array over the nodes of the window, flattened in C
    order, of shape (n,) or (n, d). None of them outlives a step. Nodes of several layers follow each other.

    The period of a *periodic* direction is the extent of the window, shape * spacing. Positions stay unwrapped; node
    indices wrap.

    Args:
        shape: nodes in each direction, d = 1, 2 or 3 of them.
        spacing: distance dx between nodes [m].
        origin: lattice index of the window's first node in each direction. Default: zeros.
        periodic: whether each direction is periodic; one bool for all of them is allowed.
        follow: whether the window moves by whole spacings to stay centred on the bounding box of the particles, with
            `origin` ignored. Results do not depend on the place of the window as long as it holds the particles.
        layers: how many nodes there are at each place. A scene sets it to the number of its `bodies`, whatever it was.
        axisymmetric: whether the directions are r and z of bodies of revolution about r = 0, whose masses, forces and
            energies are those of the whole circle; there is no torsion. The window must reach two spacings beyond an
            axis that the material meets.

    Raises:
        ValueError: a shape that is not one to three integers of at least 4, a spacing that is not positive, an origin
            or `periodic` of another length, a window that both follows and is periodic, or axisymmetry in other than
            two dimensions or with a period along r.
    """

    shape: Annotated[tuple[int, ...], between(4, math.inf)] = eqx.field(static=True, converter=tuple)
    spacing: _Spacing
    origin: tuple[int, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)
    follow: bool = eqx.field(static=True)
    layers: int = eqx.field(static=True)
    axisymmetric: bool = eqx.field(static=True, default=False)

    @checked
    def __init__(
        self,
        shape: tuple[int, ...] | list[int],
        spacing: _Spacing,
        *,
        origin: tuple[int, ...] | list[int] | None = None,
        periodic: bool | tuple[bool, ...] | list[bool] = False,
        follow: bool = False,
        layers: Annotated[int, whole(1)] = 1,
        axisymmetric: bool = False,
    ):
        self.shape = tuple(int(n) for n in shape)
        self.spacing = spacing
        self.origin = (0,) * len(self.shape) if origin is None else tuple(int(i) for i in origin)
        every = (periodic,) * len(self.shape) if isinstance(periodic, bool) else periodic
        self.periodic = tuple(bool(p) for p in every)
        self.follow = follow
        self.layers = int(layers)
        self.axisymmetric = axisymmetric

    def __check_init__(self):
        require_fields(self)
        d = len(self.shape)
        require(d in (1, 2, 3), f"A grid's shape must be one, two or three integers, got {self.shape}.")
        require(
            self.size < _MOST_NODES,
            f"A grid's window must have fewer than 2^31 nodes, got {self.size} by the shape {self.shape}: take a "
            "larger spacing, or a window that follows.",
        )
        for name, value in (("origin", self.origin), ("periodic", self.periodic)):
            require(len(value) == d, f"A grid's {name} must have {d} entries, one a direction, got {value}.")
        near = all(abs(i) + n < _MOST_NODES for i, n in zip(self.origin, self.shape, strict=True))
        require(near, f"A grid's origin must be of fewer than 2^31 nodes in size, got {self.origin}.")
        fits = not (self.follow and any(self.periodic))
        require(fits, "A periodic grid cannot follow the material: its window is its period. Drop follow or periodic.")
        require(
            not self.axisymmetric or (d == 2 and not self.periodic[0]),
            f"An axisymmetric grid must have two directions, r and z, and no period along r, got the shape {self.shape}"
            f" and periodic = {self.periodic}.",
        )

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return len(self.shape)

    @property
    def strain_dim(self) -> int:
        """Rows of a particle's deformation gradient: d, of bodies of revolution 3."""
        return 3 if self.axisymmetric else len(self.shape)

    @property
    def size(self) -> int:
        """Number of nodes n, in all layers."""
        return self.layers * math.prod(self.shape)

    def with_layers(self, count: int) -> "Grid":
        """The grid with so many nodes at each place."""
        return replace(self, layers=count)

    def coarsened(self) -> "Grid":
        """The grid of twice the spacing, whose window reaches two of its spacings farther, but in periodic directions.

        Raises:
            ValueError: a period of an odd number of spacings.
        """
        odd = [n for n, periodic in zip(self.shape, self.periodic, strict=True) if periodic and n % 2]
        require(not odd, f"A period of {odd[:1]} spacings is none of twice the spacing.")
        margin = [0 if periodic else 2 for periodic in self.periodic]
        first = tuple(i // 2 - m for i, m in zip(self.origin, margin, strict=True))
        each = zip(self.origin, self.shape, margin, first, strict=True)
        shape = tuple(n // 2 if m == 0 else -(-(i + n) // 2) + m - start for i, n, m, start in each)
        return replace(self, shape=shape, origin=first, spacing=2 * self.spacing)

    def window(self, x: ParticleVector) -> Int[Array, "d"]:
        """Lattice index of the window's first node, shape (d,), for particles at x [m], shape (p, d)."""
        if not self.follow:
            return jnp.asarray(np.asarray(self.origin, dtype=np.int32))
        middle = (x.min(axis=0) + x.max(axis=0)) / 2
        first = jnp.floor(jax.lax.stop_gradient(middle / self.spacing)).astype(jnp.int32)
        return first - jnp.asarray([count // 2 for count in self.shape], dtype=jnp.int32)

    def wrapped(self, x: ParticleVector, window: Int[Array, "d"]) -> ParticleVector:
        """The positions x moved by whole periods into the window [m], shape (p, d)."""
        if not any(self.periodic):
            return x
        period = jnp.asarray(self.shape, x.dtype) * self.spacing
        turns = jnp.floor((x - window.astype(x.dtype) * self.spacing) / period)
        return jnp.where(jnp.asarray(self.periodic), x - turns * period, x)

    def section(self, x: Any, volume: Any) -> Any:
        """Volumes [m^d] of particles at x in the window's dimension: of bodies of revolution V/(2πr) [m²]."""
        return volume / (2 * math.pi * x[:, 0]) if self.axisymmetric else volume

    def nodes(self, window: Int[Array, "d"]) -> NodeVector:
        """Positions of the window's nodes [m], shape (n, d)."""
        axes = [jnp.arange(count, dtype=jnp.int32) for count in self.shape]
        index = jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, self.dim)
        index = index if self.layers == 1 else jnp.tile(index, (self.layers, 1))
        return (index + window).astype(jnp.result_type(self.spacing)) * self.spacing
