"""Functions with rules and kernels of their own, and guards, that hold in every nest of JAX transformations."""

from mpmjax.autodiff._custom_derivative import (
    custom_derivative as custom_derivative,
    is_unknown as is_unknown,
    materialised as materialised,
    rematerialised as rematerialised,
    saved_for_backward as saved_for_backward,
    without_derivative as without_derivative,
)
from mpmjax.autodiff._guard import guard as guard
