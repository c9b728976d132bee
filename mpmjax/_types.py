"""Array aliases, and the glossary of axis names that every annotation in the package uses.

    p   particles; q those of one material
    n   nodes of the grid window, flattened in C order; m some of them, other points, or the d² rows of a matrix
    d   space dimension (1, 2 or 3)
    k   nodes of one particle's stencil, (order + 1)^d of them; colliders or boundaries
    f   saved frames; g the spans between them
    s   attached points of a load, nodes of a stencil along an axis, or components of a skew matrix
    r   components of a torque or spin (3 in 3-D, 1 in 2-D, 0 in 1-D)
    t   entries of an upper triangle, row by row
    c   components of a field that is gathered or scattered
    j   times of a motion

At the public face a particle array starts with p: positions (p, d), deformation gradients (p, d, d). Inside a step,
small matrices are *component first*, (d, d, p): `F[0, 1]` is then one contiguous array over the particles, which is
what a CPU vectorises best, and a law reads as on paper. `components` and `particle_first` go between the two. Gradients
have the axes of F, ∇u[a, b] = ∂u_a/∂x_b; `slopes`, which sums give and take, have the derivative's direction first, so
that each is one more row of a sum: slopes[b, a] = ∂u_a/∂x_b.
"""

import math
from typing import TYPE_CHECKING, Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array as Array, Bool as Bool, Float as Float, Int as Int
from typing_extensions import TypeAliasType

if TYPE_CHECKING:  # a static checker need not follow NumPy arrays into JAX expressions, which take them
    Scalar = float | Array
    PerParticle = float | Array
    Point = tuple[float | int | Array, ...] | list[float | int] | Float[Array, "d"] | Float[np.ndarray, "d"]
else:  # aliases with names, which signatures show in place of their members
    _Number = float | int | np.floating | np.integer
    Scalar = TypeAliasType("Scalar", _Number | Float[Array, ""] | Float[np.ndarray, ""])
    """A number, or an array without axes."""

    PerParticle = TypeAliasType("PerParticle", _Number | Float[Array, "*#p"] | Float[np.ndarray, "*#p"])
    """One value for all particles, or one for each."""

    _Components = tuple[float | int | Array, ...] | list[float | int]
    Point = TypeAliasType("Point", _Components | Float[Array, "d"] | Float[np.ndarray, "d"])
    """A point or vector of d numbers."""


MAY_BE_INFINITE = math.inf
"""A mark of annotations: the numbers may be infinite. Without it those in files must be finite."""

Corner = Annotated[Point, MAY_BE_INFINITE]
"""A corner of a box, with an infinite number in each direction in which the box has no end."""

Mask = Bool[Array, "n d"]
NodeScalar = Float[Array, "n"]
NodeVector = Float[Array, "n d"]
ParticleScalar = Float[Array, "p"]
ParticleVector = Float[Array, "p d"]
ParticleMatrix = Float[Array, "p d d"]
Matrix = Float[Array, "d d *p"]  # a d x d matrix per particle (or a single one), component first

Deformation = Float[Array, "..."]
"""The deformation that particles store (see `material/_law.py`), component first: F, shape (d, d, *p), or
J, shape (*p)."""

Compliance = Float[Array, "s s *p"]  # the map from the vector of a skew d x d matrix to a spin: s = 3 in 3-D, else 1

Indices = Int[Array, "k p"]


def components(a: Array) -> Array:
    """Move the particle axis last: (p, ...) to (..., p)."""
    return jnp.moveaxis(a, 0, -1)


def particle_first(a: Array) -> Array:
    """Move the particle axis first: (..., p) to (p, ...)."""
    return jnp.moveaxis(a, -1, 0)
