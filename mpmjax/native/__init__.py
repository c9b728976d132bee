"""The compiled library of CPUs: whether there is one, and how JAX calls it."""

from mpmjax.native._library import Backend as Backend, backend as backend, is_native as is_native
from mpmjax.native._primitive import (
    differentiable as differentiable,
    materialised as materialised,
    members as members,
    native_primitive as native_primitive,
    sums_fit as sums_fit,
)
