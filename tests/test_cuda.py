"""The sums in CUDA without a card: kernels on the CPU, one thread after the other, and NVRTC's word on their code."""

import ctypes
import hashlib
import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import thorough
from test_native import (
    agree,
    averaged,
    basis_for,
    first_in_window,
    pairs_of,
    problem,
    resistance,
    resisted,
    resisted_in_parts,
    summed,
    transfers,
)
from test_native_matrices import decomposed

import mpmjax as mpm
from mpmjax.cli._commands import installation
from mpmjax.discretisation import Stencil
from mpmjax.native import AbstractBackend, _backend, _library

NATIVE = Path(__file__).parents[1] / "native"
NEEDS_COMPILER = pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
NVRTC = [path for path in _library._nvrtc() if Path(path).is_file()]
NEEDS_NVRTC = pytest.mark.skipif(
    not (NVRTC and _library.CUDA_PATH.is_file()), reason="there is no NVRTC (nvidia-cuda-nvrtc-cu12), or no library"
)


class OneByOne(AbstractBackend):
    """The kernels for cards, with a loop over threads in the place of a launch."""

    name = "one by one"
    platform = "cpu"
    prefix = "one_thread_"
    has = _backend.Cuda.has


@pytest.fixture(scope="session")
def kernels(pytestconfig):
    """Kernels for a CPU, compiled once and kept in pytest's cache as long as their sources are the same."""
    source = NATIVE / "check_one_thread.cc"
    sources = b"".join(path.read_bytes() for path in (source, *sorted(NATIVE.glob("*.h")))) + jax.__version__.encode()
    folder = pytestconfig.cache.mkdir("one_thread")
    path = folder / f"{hashlib.sha256(sources).hexdigest()[:16]}.so"
    if not path.is_file():
        command = ["c++", "-std=c++17", "-shared", "-fPIC", "-Wno-psabi", "-isystem", jax.ffi.include_dir()]
        subprocess.run([*command, str(source), "-o", str(path)], check=True)
    handle = ctypes.CDLL(str(path))
    for name in _library.CUDA_KERNELS:
        capsule = jax.ffi.pycapsule(getattr(handle, f"mpmjax_{name}"))
        jax.ffi.register_ffi_target(f"one_thread_{name}", capsule, platform="cpu")


@pytest.fixture
def one_by_one(kernels, choose, monkeypatch):
    """What a function gives by the kernels for cards, and by XLA; the first must call them."""
    monkeypatch.setattr(_backend, "BACKENDS", (OneByOne,))

    def both(function, *args):
        found = []
        for name in ("one by one", "xla"):
            choose(name)
            program = jax.jit(lambda *args: function(*args)).lower(*args)
            assert ("one_thread_" in program.as_text()) == (name == "one by one")
            found.append(program.compile()(*args))
        return found

    return both


CASES = [(d, s, c) for d in (1, 2, 3) for s in (2, 3, 4) for c in (d, d + 1) if (d, s, c) != (2, 3, 3)]


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "s", "c"), [(2, 3, 3), *thorough(*CASES, (2, 3, 6), (3, 3, 1))])
def test_sums_agree(one_by_one, d, s, c, dtype):
    """With nodes beyond the window, and around periodic axes."""
    args = problem(d, s, c, 21, dtype)

    def each(xi, *floats):
        around = summed(basis_for(d, s, periodic=True), first_in_window(xi, s), *floats)
        return summed(basis_for(d, s), xi, *floats), around

    agree(*one_by_one(each, *args), dtype)


@NEEDS_COMPILER
@pytest.mark.parametrize("d", [1, *thorough(2, 3)])
def test_sums_agree_whatever_is_given(one_by_one, d):
    """Of the value, gradients, or both, of fewer columns too; of squares, moved along dξ, and in a batch."""
    args, basis, c = problem(d, 3, 2, 21, "float64"), basis_for(d, 3), 2

    def each(xi, *floats):
        squared = Stencil(xi, jnp.ones(()), jnp.ones(21, bool), basis).squared.basis
        moved = jax.jvp(lambda xi: summed(basis, xi, *floats), (xi,), (jnp.cos(xi),))[1]
        choices = ({"graded": False}, {"valued": False}, {"graded": c - 1})
        return (
            [summed(basis, xi, *floats, **which) for which in choices],
            summed(squared, xi, *floats),
            moved,
        )

    agree(*one_by_one(each, *args), "float64")
    pair = [jnp.stack(two) for two in zip(args, problem(d, 3, c, 21, "float64", seed=1), strict=True)]
    agree(*one_by_one(jax.vmap(partial(summed, basis)), *pair), "float64")


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_averages_and_resistances_agree(one_by_one, d, dtype):
    """With empty nodes, for no particle, and in a batch."""
    for p in (30, 0):
        xi, given, _ = problem(d, 3, 3, p, dtype)
        found, expected = one_by_one(averaged, xi, given[0], given[1:])
        agree(found, expected, dtype)
        assert (found[0] == 0).any()
    args = resistance(d, 30, dtype)
    found, expected = one_by_one(resisted, *args)
    agree(found, expected, dtype)
    agree(found, jax.jit(resisted_in_parts)(*args), dtype)
    pair = [jnp.stack(two) for two in zip(args, resistance(d, 30, dtype, seed=2), strict=True)]
    agree(*one_by_one(jax.vmap(resisted), *pair), dtype)


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "order"), [(2, 1), *thorough((1, 1), (2, 2), (3, 2), (3, 3))])
def test_transfers_agree(one_by_one, d, order, dtype):
    """Alone and in a batch of other spacings, steps and factors."""
    moved, args = transfers(d, order, dtype)
    agree(*one_by_one(moved, *args), dtype)
    agree(*one_by_one(jax.vmap(moved), *pairs_of(args)), dtype)


@NEEDS_COMPILER
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
def test_decompositions_agree(one_by_one, dtype):
    """Of random matrices and of zero, in a batch."""
    F = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 3, 40)), dtype).at[..., 7].set(0)
    agree(*one_by_one(jax.vmap(decomposed), F), dtype)


@NEEDS_COMPILER
def test_a_particle_that_is_not_finite_spoils_its_own_nodes_alone(one_by_one):
    """As in XLA: the same entries are finite."""
    xi, given, nodes = problem(2, 3, 3, 20, "float32")
    found, expected = one_by_one(partial(summed, basis_for(2, 3)), xi.at[:, 5].set(jnp.nan), given, nodes)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(jnp.isfinite(a), jnp.isfinite(b)), found, expected)


@NEEDS_NVRTC
@pytest.mark.parametrize("card", ["sm_90", *thorough("sm_80", "sm_100")])
@pytest.mark.parametrize(
    ("number", "dimensions"),
    [("float", "3, 3, 4"), *thorough(("double", "3, 4, 0"), ("float", "2, 3, 2"), ("double", "1, 2, 1"))],
)
def test_nvrtc_compiles_the_kernels(card, number, dimensions, tmp_path):
    """For cards of these capabilities, none of which is here; and what was compiled is kept."""
    library = ctypes.CDLL(str(_library.CUDA_PATH))
    library.mpmjax_compile.restype = ctypes.c_char_p

    def fault(name):
        of, terms = ("0, 0, 0", 0) if name in ("Average", "Eigen", "Rotation") else (dimensions, 3)
        texts = (text.encode() for text in (NVRTC[0], str(tmp_path), f"{name}<{number}>", of))
        return library.mpmjax_compile(*texts, terms, card.encode()).decode()

    names = [{"p2g": "P2G", "g2p": "G2P"}.get(name, name.capitalize()) for name in _library.CUDA_KERNELS]
    assert [fault(name) for name in names] == [""] * len(names)
    assert len(list(tmp_path.glob("*.cubin"))) == len(names)
    assert "Nothing" in fault("Nothing")


STAND_INS = """
#include <cstring>
#include <utility>
extern "C" {
#define RETURNS(name) int name(...) { return 0; }
RETURNS(cuInit) RETURNS(cuDeviceGet) RETURNS(cuCtxPushCurrent_v2) RETURNS(cuCtxPopCurrent_v2) RETURNS(cuStreamGetCtx)
RETURNS(cuCtxGetDevice) RETURNS(cuModuleGetFunction) RETURNS(cuMemsetD32Async) RETURNS(cuLaunchKernel)
RETURNS(cuGetErrorName) RETURNS(cuDevicePrimaryCtxRetain)
RETURNS(nvrtcVersion) RETURNS(nvrtcCreateProgram) RETURNS(nvrtcDestroyProgram)
RETURNS(nvrtcGetProgramLogSize) RETURNS(nvrtcGetProgramLog)
int cuDeviceGetCount(int* count) { return *count = CARDS, 0; }
int cuDeviceGetAttribute(int* value, int attribute, int) { return *value = attribute == 75 ? 9 : 0, 0; }
int mode;  // global, in which nothing may be loaded while a stream is captured; 2 is relaxed
int cuThreadExchangeStreamCaptureMode(int* other) { return std::swap(mode, *other), 0; }
int cuModuleLoadData(void**, const void* code) {
  return mode != 2 || std::strcmp(static_cast<const char*>(code), "code for sm_90");
}
const char* target;
int nvrtcCompileProgram(void*, int, const char** options) { return target = std::strchr(options[0], '=') + 1, 0; }
int nvrtcGetCUBINSize(void*, size_t* size) { return *size = 15, 0; }
int nvrtcGetCUBIN(void*, char* code) { return std::strcpy(code, "code for "), std::strcat(code, target), 0; }
}
"""
PROGRAM = """
import ctypes
import jax, mpmjax as mpm
from helpers import block
from mpmjax.native import _backend, _library
_library._nvrtc = lambda: ["libnvrtc.so.13"]  # not one that is installed
print(_backend.Cuda.absence())
print(ctypes.c_int.in_dll(ctypes.CDLL("libcuda.so.1"), "mode").value)
scene, particles = block(2)
run = jax.jit(lambda q: mpm.rollout(scene, q, steps=1, dt=1e-3).x)
text = run.trace(mpm.prepare(scene, particles)).lower(lowering_platforms=("cuda",)).as_text()
print("mpmjax_p2g" in text, "mpmjax_g2p" in text)
"""


@NEEDS_COMPILER
@pytest.mark.skipif(not _library.CUDA_PATH.is_file(), reason="the library for cards was not built")
@pytest.mark.parametrize(
    ("cards", "lines"), [(1, ["", "0", "True True"]), *thorough((0, ["the driver has no card", "0", "False False"]))]
)
def test_where_there_is_a_driver_programs_for_cards_call_the_kernels(cards, lines, tmp_path):
    """By stand-ins for the driver and NVRTC, which say what a card of capability 9.0 would."""
    source = tmp_path / "stand_ins.cc"
    source.write_text(STAND_INS)
    command = ["c++", "-shared", "-fPIC", f"-DCARDS={cards}", str(source), "-o"]
    for name in ("libcuda.so.1", "libnvrtc.so.13"):
        subprocess.run([*command, str(tmp_path / name)], check=True)
    path = f"{NATIVE.parent}{os.pathsep}{NATIVE.parent / 'tests'}"
    variables = {"LD_LIBRARY_PATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": path}
    environment = os.environ | variables | {"MPMJAX_BACKEND": "cuda" if cards else "", "JAX_PLATFORMS": "cpu"}
    out = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert out.stdout.splitlines() == lines
    kept = [file.read_bytes() for file in (tmp_path / "mpmjax").glob("*.cubin")]
    assert (b"code for sm_90\0" in kept) == bool(cards)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there may be a card")
def test_without_a_card_one_line_says_why_and_xla_sums(choose, monkeypatch, capfd):
    """`mpmjax info` too; nothing else is said, and to ask for it is an error."""
    monkeypatch.delenv("MPMJAX_BACKEND", raising=False)
    reason = _backend.Cuda.absence()
    assert reason
    assert "\n" not in reason
    assert str(mpm.native.backend("cuda")) == "XLA (cuda is on trial, taken with MPMJAX_BACKEND=cuda)"
    assert mpm.native.backend("rocm").name == "xla"
    choose("cuda")
    with pytest.raises(ValueError, match="asks for the cuda sums, but there is no library of them that can be used"):
        mpm.native.backend("cuda")
    assert mpm.native.backend("cpu").name == "xla"
    assert f"cuda       {reason}" in installation()
    assert capfd.readouterr() == ("", "")


def test_nvrtc_is_found_in_wheels(monkeypatch, tmp_path):
    """All that there are, and then where the loader looks: the first that a card takes is taken."""
    places = [tmp_path / "nvidia" / folder for folder in ("cuda_nvrtc/lib/libnvrtc.so.12", "cu13/lib/libnvrtc.so.13")]
    for place in places:
        place.parent.mkdir(parents=True)
        place.touch()
    (tmp_path / "nvidia" / "cu13" / "lib" / "libnvrtc-builtins.so.13.0").touch()
    monkeypatch.syspath_prepend(tmp_path)
    found = list(_library._nvrtc())
    assert [path for path in found if str(tmp_path) in path] == [str(places[0]), str(places[1])]
    assert found[-1] == "libnvrtc.so.12"


@pytest.mark.thorough
def test_the_script_for_a_card_runs(tmp_path):
    """On this device with tiny scenes: each row of its table is there, and finite."""
    rows = tmp_path / "rows.json"
    script = NATIVE.parent / "benchmarks" / "gpu.py"
    subprocess.run([sys.executable, str(script), "--quick", "--json", str(rows)], check=True)
    told = json.loads(rows.read_text())["rows"]
    assert [row["right"] for row in told if "right" in row] == [True, True]
    assert len(told) == 8
    assert all(np.isfinite(value) for row in told for key, value in row.items() if key != "what")
