"""Back ends: who evaluates what has kernels, and the library of CPUs."""

from mpmjax.native._backend import BACKENDS as BACKENDS, AbstractBackend as AbstractBackend, backend as backend
