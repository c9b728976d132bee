"""The compiled library of CPUs: whether there is one, and how JAX calls it."""

from mpmjax.native._library import Backend as Backend, backend as backend, is_native as is_native
from mpmjax.native._primitive import (
    differentiable as differentiable,
    members as members,
    native_primitive as native_primitive,
    stored as stored,
    sums_fit as sums_fit,
)
