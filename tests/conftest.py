"""Settings of every test: 64-bit numbers, strict dtype promotion, array shapes and dtypes checked at every call."""

import os
from typing import Any

import matplotlib

matplotlib.use("Agg")

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

with install_import_hook("mpmjax", "beartype.beartype"):
    import mpmjax  # noqa: F401


def pytest_configure(config: Any) -> None:
    """Most of the default tests' time is XLA's compiler's, which takes three tenths less where it does not optimise the
    machine's code; the slow ones, which compute for longer, are compiled as for users."""
    if config.option.markexpr == "not slow":
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"


def pytest_runtest_teardown(item: Any, nextitem: Any) -> None:
    """Drop compiled programs that no later test shares. Each holds memory maps, of which a process may have 65530, and
    XLA crashes when there are no more."""
    if nextitem is None or nextitem.module is not item.module or item.get_closest_marker("slow"):
        jax.clear_caches()
