"""Registries and small scenes that the tests share. A new kernel, law or method costs one line here."""

from collections.abc import Callable, Collection
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpmjax as mpm
from mpmjax._types import Array
from mpmjax.io import _schema
from mpmjax.native import _library

DIMS = (1, 2, 3)
KERNELS = {"linear": mpm.BSpline(1), "quadratic": mpm.BSpline(2), "cubic": mpm.BSpline(3)}
GRADIENTS = {"spline": mpm.SplineGradient(), "mls": mpm.MLSGradient()}
TRANSFERS = {"pic": mpm.PIC(), "flip": mpm.FLIP(0.95), "apic": mpm.APIC()}
LAWS = {
    "fixed_corotated": mpm.FixedCorotated(youngs_modulus=1e4, poisson_ratio=0.3),
    "neo_hookean": mpm.NeoHookean(youngs_modulus=1e4, poisson_ratio=0.3),
}
ELASTIC = LAWS | {"hencky": mpm.Hencky(youngs_modulus=1e4, poisson_ratio=0.3)}
"""All elastic laws, for what is cheap or a law's own; `LAWS` for what is multiplied by other choices."""
RUBBER = {
    "mooney_rivlin": mpm.MooneyRivlin(1.5e3, 5e2, bulk_modulus=2e4),
    "yeoh": mpm.Yeoh(2e3, -50.0, 5.0, bulk_modulus=2e4),
    "gent": mpm.Gent(4e3, limit=10.0, bulk_modulus=2e4),
    "ogden": mpm.Ogden((2e3, -500.0), (1.8, -2.5), bulk_modulus=2e4),
}
"""Laws of rubber, which are of one form (`AbstractRubber`)."""
PLASTIC = {
    "snow": mpm.Snow(1e4, 0.2, critical_compression=2.5e-2, critical_stretch=7.5e-3, hardening=10.0),
    "von_mises": mpm.VonMises(1e4, 0.3, yield_stress=400.0, hardening_modulus=1e3),
    "drucker_prager": mpm.DruckerPrager(1e4, 0.3, friction_angle=0.6),
    "cam_clay": mpm.CamClay(1e4, 0.3, friction=1.0, preconsolidation=300.0, cohesion=0.5, hardening=3.0),
    "herschel_bulkley": mpm.HerschelBulkley(1e4, 0.3, yield_stress=200.0, consistency=10.0, exponent=0.7),
}
"""Laws that yield."""
FLUIDS = {"fluid": mpm.Fluid(1e4), "fluid_in_tension": mpm.Fluid(1e4, tension=True)}
"""Laws that know J alone, in the updated description."""
VISCOUS = {
    "viscous_solid": mpm.Viscous(LAWS["neo_hookean"], 20.0, 5.0),
    "viscous_fluid": mpm.Viscous(FLUIDS["fluid_in_tension"], 20.0, 5.0),
}
"""Laws with viscosity beside them."""
QUICK = ("explicit", "semi_implicit")
"""The updates of the default and the thorough tests where every update is tested at length."""
DESCRIPTIONS = {"updated": mpm.UpdatedLagrangian(), "total": mpm.TotalLagrangian()}
METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit(), "backward_euler": mpm.BackwardEuler()}
SECOND_ORDER = {"implicit_midpoint": mpm.ImplicitMidpoint(), "trbdf2": mpm.TRBDF2()}


def beside_a_half(batched: Callable) -> Callable:
    """Asks a batched function for its value at x beside that at 0.5."""
    return lambda x: batched(jnp.stack([x, 0.5 + 0 * x]))


REVERSE = {
    "vmap": lambda f: beside_a_half(jax.vmap(f)),
    "jit": jax.jit,
    "grad": jax.grad,
    "value_and_grad": jax.value_and_grad,
    "jit_grad": lambda f: jax.jit(jax.grad(f)),
    "grad_jit": lambda f: jax.grad(jax.jit(f)),
    "vmap_jit_grad": lambda f: beside_a_half(jax.vmap(jax.jit(jax.grad(f)))),
    "jit_grad_vmap": lambda f: jax.jit(jax.grad(lambda x: beside_a_half(jax.vmap(f))(x).sum())),
    "jit_vjp": lambda f: jax.jit(lambda x: jax.vjp(f, x)[1](jnp.ones_like(f(x)))[0]),
    "jit_jacrev": lambda f: jax.jit(jax.jacrev(f)),
    "jit_grad_remat": lambda f: jax.jit(jax.grad(jax.checkpoint(f))),
    "jit_grad_scan": lambda f: jax.jit(
        jax.grad(lambda x: jax.lax.scan(lambda c, _: (c + f(x), None), jnp.zeros_like(x), None, length=2)[0])
    ),
}
"""Ways to ask a function of one number for numbers or for derivatives in reverse mode."""
FORWARD = {
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),)),
    "jit_jvp": lambda f: jax.jit(lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]),
    "jit_jacfwd": lambda f: jax.jit(jax.jacfwd(f)),
    "jit_linearize": lambda f: jax.jit(lambda x: jax.linearize(f, x)[1](jnp.ones_like(x))),
}
"""In forward mode."""
SECOND = {
    "jit_hessian": lambda f: jax.jit(jax.hessian(f)),
    "jit_grad_grad": lambda f: jax.jit(jax.grad(jax.grad(f))),
    "jit_jacfwd_jacfwd": lambda f: jax.jit(jax.jacfwd(jax.jacfwd(f))),
}
"""Second derivatives."""


def ids(registry: dict, default: str | Collection[str] | None = None, thorough: Collection[str] | None = None) -> dict:
    """The keyword arguments that parametrise a test over a registry. The names in `default` belong to the default run;
    without it all do. The other names are marked thorough, or where `thorough` is given, those in it thorough and what
    is in neither slow."""
    default = {default} if isinstance(default, str) else set(registry if default is None else default)
    thorough = set(registry) if thorough is None else set(thorough)
    if unknown := (default | thorough) - set(registry):
        raise ValueError(f"The registry has no {sorted(unknown)}; its names are {list(registry)}.")
    values = []
    for name, value in registry.items():
        further = pytest.mark.thorough if name in thorough else pytest.mark.slow
        values.append(value if name in default else pytest.param(value, marks=further))
    return {"argvalues": values, "ids": list(registry)}


NEEDS_LIBRARY = pytest.mark.skipif(not _library.PATH.is_file(), reason="the native library was not built")


def thorough(*cases: object) -> list:
    """Cases of a parametrised test that the default run leaves out. A tuple holds the values of several arguments."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.thorough) for case in cases]


def slow(*cases: object) -> list:
    """Cases of a parametrised test that take too long for the thorough run."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]


def rotation_matrix(d: int, rng: np.random.Generator) -> np.ndarray:
    """A random rotation."""
    q = np.linalg.qr(rng.normal(size=(d, d)))[0]
    q[:, 0] *= np.sign(np.linalg.det(q))
    return q


def cloud(d: int, *, p: int = 20, seed: int = 0, cells: int = 6, dx: float = 0.1) -> tuple[mpm.Grid, mpm.Particles]:
    """A grid and random particles well inside it, with random velocity, affine velocity and deformation."""
    rng = np.random.default_rng(seed)
    grid = mpm.Grid((cells + 5,) * d, dx, origin=(-2,) * d)
    x = jnp.asarray(rng.uniform(0, cells * dx, (p, d)))
    particles = mpm.Particles(
        x=x,
        v=jnp.asarray(rng.normal(size=(p, d))),
        mass=jnp.asarray(rng.uniform(0.5, 1.5, p)),
        volume=jnp.asarray(rng.uniform(0.5, 1.5, p) * (dx / 2) ** d),
        deformations=(jnp.asarray(np.eye(d) + 0.1 * rng.normal(size=(p, d, d))),),
        C=jnp.asarray(rng.normal(size=(p, d, d))),
        X=x,
    )
    return grid, particles


def block(d: int, *, side: int = 3, dx: float = 0.1, **scene: object) -> tuple[mpm.Scene, mpm.Particles]:
    """A small elastic block at rest in a window with room around it."""
    grid = mpm.Grid((side + 6,) * d, dx, origin=(-3,) * d)
    particles = mpm.fill(mpm.Box((0.0,) * d, (side * dx,) * d), grid, particles_per_cell=2**d, density=1e3)
    material = scene.pop("material", LAWS["fixed_corotated"])
    return mpm.Scene(grid, material, **scene), particles


def explicit_limit(scene: mpm.Scene) -> float:
    """dx / c [s], c the pressure-wave speed at rest."""
    (law,) = scene.laws
    law = law.law if isinstance(law, mpm.Viscous) else law
    if isinstance(law, mpm.material.AbstractInelastic) and not isinstance(law, mpm.Fluid):
        law = law.elastic(law.initial_history(jnp.ones((1, 1))))
    modulus = law.bulk_modulus if isinstance(law, mpm.Fluid) else law.lame_lambda + 2 * law.shear_modulus
    return float(scene.grid.spacing) / float(np.sqrt(modulus / 1e3))


def assert_close(a: Array, b: Array, rtol: float = 1e-12, atol: float = 0.0) -> None:
    """Relative to the largest entry, since rounding is. Nothing is close to NaN, and there must be something."""
    a, b = np.asarray(a), np.asarray(b)
    assert a.size > 0, "nothing to compare"
    scale = max(np.abs(a).max(initial=0), np.abs(b).max(initial=0))
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * scale + atol, equal_nan=False)


def assert_files_hold(path: Path, run: mpm.Run, *own: type) -> None:
    """A run comes back from its file as it was saved: classes, numbers and final state, bit for bit. Where one of the
    classes is not registered, loading says so."""
    mpm.save(path, run)
    again = mpm.load(path)
    for part in ("scene", "method", "final"):
        found, saved = (jax.tree.flatten(getattr(r, part)) for r in (again, run))
        assert found[1] == saved[1], part
        for a, b in zip(found[0], saved[0], strict=True):
            np.testing.assert_array_equal(a, b)
    for cls in own:
        unknown = rf"unknown kind '{cls.__name__}'.* is known when the module is imported that calls mpm\.register"
        with mock.patch.dict(_schema._registered):
            del _schema._registered[cls.__name__]
            with pytest.raises(ValueError, match=unknown):
                mpm.load(path)
