"""The basis of a program's sums: how nodes are numbered, and the polynomials of which weights are products."""

import math
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import BSpline, around_knots

Kind = tuple[int, int]
"""A one-dimensional polynomial for each node: 0 for the weights or 1 for the gradient's factors, and how many times it
is differentiated."""
Term = tuple[Kind, ...]
"""A polynomial along each axis, whose product is one number for each node of a particle."""


class Basis(NamedTuple):
    """Numbering of nodes, and polynomials, fixed in a program.

    The i-th node along an axis from the first one on has the polynomials
    Σ_k c_ik (t − τ_i)^k in the offset t, around knots τ at which small weights are small by a power and not by a
    difference."""

    shape: tuple[int, ...]
    """Nodes along each axis."""
    periodic: tuple[bool, ...]
    """Whether each axis is."""
    knots: tuple[float, ...]
    """τ, of the s nodes along an axis."""
    weights: tuple[tuple[float, ...], ...]
    """c of the weights [-]."""
    slopes: tuple[tuple[float, ...], ...]
    """c of the gradient's factors [1/spacing]."""
    moments: tuple[tuple[float, ...], ...]
    """c of these factors by moving least squares [1/spacing]."""

    @property
    def strides(self) -> list[int]:
        """Distance in the C-order node index of neighbours along each axis."""
        return [math.prod(self.shape[a + 1 :]) for a in range(len(self.shape))]

    @property
    def value(self) -> tuple[Term]:
        """The term of the weights."""
        return (((0, 0),) * len(self.shape),)

    @property
    def gradient(self) -> tuple[Term, ...]:
        """The terms of the gradient's components."""
        axes = range(len(self.shape))
        return tuple(tuple((1, 0) if b == a else (0, 0) for b in axes) for a in axes)

    def index_terms(self, first: Int[Array, "*b d p"]) -> Int[Array, "*b d s p"]:
        """The share of each axis in the flat index of a node. Around a periodic axis the nodes after its last are its
        first ones."""
        along = first[..., None, :] + jnp.arange(len(self.knots), dtype=first.dtype)[:, None]
        if any(self.periodic):  # by whole numbers in the code: XLA divides by those in an array one by one
            axes = [along[..., a, :, :] for a in range(len(self.shape))]
            for a in np.flatnonzero(self.periodic):
                n = self.shape[a]
                axes[a] = axes[a] - n * (axes[a] // n - first[..., a, None, :] // n)
            along = jnp.stack(axes, axis=-3)
        return along * np.array(self.strides, np.int32)[:, None, None]

    def polynomials(self, kind: Kind, t: Float[Array, "*b p"]) -> Float[Array, "*b s p"]:
        """The polynomials of a kind at offsets along an axis, or along several."""
        return around_knots(_coefficients(self, kind), np.array(self.knots), t)


def basis_of(kernel: BSpline, grid: Grid, slopes: Float[np.ndarray, "s k"] | None = None) -> Basis:
    """The basis of a kernel on a grid, with the gradient's factors as `kernel.slopes`; by default these."""
    tables = kernel.pieces, kernel.slopes if slopes is None else slopes, kernel.moments
    rows = (tuple(map(tuple, np.asarray(table).tolist())) for table in tables)
    return Basis(grid.shape, grid.periodic, tuple(kernel.knots.tolist()), *rows)


def differentiated(terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """The derivatives of terms by t, along the first axis of all, along the second of all, ..."""
    axes = range(len(terms[0]))
    return tuple((*term[:b], (term[b][0], term[b][1] + 1), *term[b + 1 :]) for b in axes for term in terms)


@cache
def _coefficients(basis: Basis, kind: Kind) -> Float[np.ndarray, "s k"]:
    family, order = kind
    rows = np.array((basis.weights, basis.slopes)[family])
    return np.polynomial.polynomial.polyder(rows, order, axis=1) if order else rows
