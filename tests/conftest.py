"""Settings of every test: 64-bit numbers, strict dtype promotion, array shapes and dtypes checked at every call, and
how far XLA optimises what they compile."""

import functools
import gc
import os
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import jax
import pytest
from annotations import checks_of_imports
from jax._src.interpreters import mlir


def pytest_configure(config: Any) -> None:
    """Import the package as tests see it, in processes that run tests: what only hands them out would wait for it.

    The default tests and the thorough ones compile quickly: half of their time is XLA's. Level 0 takes three tenths off
    it, the older emitter of loops half of the rest. A run that may hold slow tests, which compute for longer, is
    compiled as users' programs are."""
    if "not slow" in config.option.markexpr:
        os.environ["XLA_FLAGS"] = " ".join((os.environ.get("XLA_FLAGS", ""), *QUICK_TO_COMPILE))
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = KEPT.name
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_traceback_in_locations_limit", 0)  # no lines of Python in programs: a thirtieth of the time
    # MLIR's dialects are loaded once, and not for each program but those lowered within another: a tenth of the time
    new, kept = mlir.make_ir_context, functools.cache(mlir.make_ir_context)
    mlir.make_ir_context = lambda: kept() if mlir.ir.Context.current is None else new()
    with checks_of_imports("mpmjax"):
        import mpmjax.extensions
        import mpmjax.stepping  # noqa: F401
    # tracing makes many objects, few of them in cycles: looking for those took a twelfth of the time
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


KEPT = tempfile.TemporaryDirectory()
"""Where commands that tests start keep their programs, and not in the user's home."""

QUICK_TO_COMPILE = [
    "--xla_backend_optimization_level=0",
    "--xla_cpu_parallel_codegen_split_count=1",  # small programs: one module of LLVM
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion",  # a third of the time where loops hold contacts
]
"""Flags of XLA on CPUs with which a program compiles in a third of the time and runs slower."""
if jax.__version_info__ < (0, 11):  # later ones end at a flag that they do not know
    QUICK_TO_COMPILE.append("--xla_cpu_use_fusion_emitters=false")


def pytest_sessionfinish() -> None:
    """At its end pytest looks for cycles several times, a second each in what compiled programs are made of."""
    gc.freeze()


def pytest_runtest_teardown(item: Any, nextitem: Any) -> None:
    """Drop compiled programs that no later test shares, or that are too many. Each holds memory maps, of which a
    process may have 65530, and XLA crashes when there are no more. Kept for later modules, they took 10 GB
    and gained nothing."""
    leaves = nextitem is None or nextitem.module is not item.module
    if leaves or item.get_closest_marker("slow") or (item.get_closest_marker("thorough") and _maps() > MOST_MAPS):
        jax.clear_caches()


def _maps() -> int:
    """Memory maps of this process, zero where the system does not say."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0


MOST_MAPS = 30_000
"""Memory maps up to which a module's programs are kept."""


@pytest.fixture
def choose(monkeypatch):
    """Makes the back end of what is compiled next."""

    def chosen(name):
        jax.clear_caches()
        monkeypatch.setenv("MPMJAX_BACKEND", name)

    yield chosen
    jax.clear_caches()
