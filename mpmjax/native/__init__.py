"""The compiled library of CPUs: whether there is one, and how JAX calls it."""

from mpmjax.native._backend import Backend, backend, is_native
from mpmjax.native._lowering import sums_fit
from mpmjax.native._primitive import differentiable, members, native_primitive
from mpmjax.native._stored import stored

__all__ = ["Backend", "backend", "differentiable", "is_native", "members", "native_primitive", "stored", "sums_fit"]
