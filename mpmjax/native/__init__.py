"""The compiled library of CPUs: whether there is one, and how JAX calls it."""

from mpmjax.native._function import (
    NativeFunction as NativeFunction,
    call_library as call_library,
    materialised as materialised,
    ranks_may_differ as ranks_may_differ,
)
from mpmjax.native._library import Backend as Backend, backend as backend, is_native as is_native
