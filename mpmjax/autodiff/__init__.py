"""Derivative rules and guards that hold in every nest of JAX transformations."""

from mpmjax.autodiff._guard import guard as guard
from mpmjax.autodiff._recompute import kept as kept, kept_sums as kept_sums, recomputed as recomputed
from mpmjax.autodiff._rule import ruled as ruled, without_derivative as without_derivative
