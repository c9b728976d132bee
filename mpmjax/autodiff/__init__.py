"""Derivative rules and guards that hold in every nest of JAX transformations."""

from mpmjax.autodiff._guard import guard as guard
from mpmjax.autodiff._rematerialise import (
    rematerialised as rematerialised,
    saved_for_backward as saved_for_backward,
    sums_saved_for_backward as sums_saved_for_backward,
)
from mpmjax.autodiff._rule import ruled as ruled, without_derivative as without_derivative
