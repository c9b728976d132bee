"""Derivative rules and guards that hold in every nest of JAX transformations."""

from mpmjax.autodiff._guard import guard
from mpmjax.autodiff._recompute import kept, kept_sums, recomputed
from mpmjax.autodiff._rule import ruled, without_derivative

__all__ = ["guard", "kept", "kept_sums", "recomputed", "ruled", "without_derivative"]
