"""The compiled sums of CPUs: whether there are any, and how JAX calls them."""

from mpmjax.native._backend import Backend, backend
from mpmjax.native._lowering import sums_fit
from mpmjax.native._primitive import members, native_primitive

__all__ = ["Backend", "backend", "members", "native_primitive", "sums_fit"]
