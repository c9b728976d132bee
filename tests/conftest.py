"""Settings of every test: 64-bit numbers, strict dtype promotion, array shapes and dtypes checked at every call."""

import os
from typing import Any
from zlib import crc32

import matplotlib

matplotlib.use("Agg")

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

with install_import_hook("mpmjax", "beartype.beartype"):
    import mpmjax  # noqa: F401


def pytest_configure(config: Any) -> None:
    """Most of the time of what is not slow is XLA's compiler's, which takes three tenths less where it does not
    optimise the machine's code; the slow tests, which compute for longer, are compiled as for users."""
    if config.option.markexpr == "rest" or "not slow" in config.option.markexpr:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: Any, items: list[Any]) -> None:
    """Where neither files nor cases are asked for, leave to `-m rest` what is neither slow nor the last case of its
    test, the hardest as a rule, but for one in six, drawn by its name: what breaks seldom breaks a single case."""
    if config.args_source is not config.ArgsSource.TESTPATHS or config.option.keyword:
        return
    tests: dict[str, list[Any]] = {}
    for item in items:
        if not item.get_closest_marker("slow"):
            tests.setdefault(item.nodeid.split("[")[0], []).append(item)
    for cases in tests.values():
        for item in cases[:-1]:
            if crc32(item.nodeid.encode()) % 6:
                item.add_marker("rest")


def pytest_runtest_teardown(item: Any, nextitem: Any) -> None:
    """Drop compiled programs that no later test shares. Each holds memory maps, of which a process may have 65530, and
    XLA crashes when there are no more."""
    if nextitem is None or nextitem.module is not item.module or item.get_closest_marker("slow"):
        jax.clear_caches()
