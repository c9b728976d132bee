"""The compiled sums of CPUs: whether there are any, and how JAX calls them."""

from mpmjax.native._backend import Backend, backend
from mpmjax.native._lowering import with_native

__all__ = ["Backend", "backend", "with_native"]
