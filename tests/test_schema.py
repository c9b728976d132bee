"""Objects as plain data, and what is said of data that describe none."""

import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ids

import mpmjax as mpm
from mpmjax.boundary._collider import AbstractCollider
from mpmjax.geometry._motion import AbstractMotion
from mpmjax.geometry._region import AbstractRegion
from mpmjax.implicit import Guess
from mpmjax.io import _schema
from mpmjax.io._schema import arguments, decode, encode, saved_classes
from mpmjax.stepping import AbstractIntegrator

GRID = mpm.Grid((8, 9), 0.1, origin=(-2, 3), periodic=(True, False))
GRIP = mpm.Grip(mpm.Box((-np.inf, 0.0), (0.1, 1.0)), mpm.Motion((0.0, 0.3), ((0.0, 0.0), (0.1, 0.7))), (True, False))
PATCH = mpm.Patch(mpm.Ball((0.1, 0.2), 0.3), mpm.Box((0.0, 0.0), (1.0, 1.0)), 0.05)
EXAMPLES = {
    mpm.Scene: mpm.Scene(
        GRID,
        mpm.NeoHookean(1e5, 0.45),
        gravity=(0.1, -9.81),
        boundary=(mpm.SlipBox((0.0, -np.inf), (1.0, np.inf)), GRIP),
        kernel=mpm.BSpline(3),
        gradient=mpm.SplineGradient(),
        transfer=mpm.FLIP(0.97),
        description=mpm.TotalLagrangian(),
    ),
    mpm.Grid: GRID,
    mpm.FixedCorotated: mpm.FixedCorotated(1 / 3, 0.3),
    mpm.NeoHookean: mpm.NeoHookean(np.array([1.0, 2.0]), 0.3),
    mpm.Hencky: mpm.Hencky(2e5, 0.2),
    mpm.MooneyRivlin: mpm.MooneyRivlin(1e5, 3e4, 2e8),
    mpm.Yeoh: mpm.Yeoh(np.array([1e5, 2e5]), -1e3, 30.0, 2e8),
    mpm.Gent: mpm.Gent(3e5, 80.0, 2e8),
    mpm.Ogden: mpm.Ogden((6e5, -1e4), (1.3, -2.0), 2e8),
    mpm.Snow: mpm.Snow(1.4e5, 0.2, hardening=7.0),
    mpm.VonMises: mpm.VonMises(2e11, 0.3, yield_stress=2.5e8, hardening_modulus=1e9),
    mpm.HerschelBulkley: mpm.HerschelBulkley(1e4, 0.4, yield_stress=50.0, consistency=20.0, exponent=0.4),
    mpm.DruckerPrager: mpm.DruckerPrager(3.5e5, 0.3, friction_angle=0.6),
    mpm.CamClay: mpm.CamClay(1e6, 0.3, friction=1.2, preconsolidation=3e4, cohesion=0.3, hardening=2.0),
    mpm.Snow: mpm.Snow(1e5, hardening=7.0),
    mpm.Viscous: mpm.Viscous(mpm.NeoHookean(1e5, 0.4), 3.0, 1.0),
    mpm.Fluid: mpm.Fluid(2e5, 1.4, tension=True),
    mpm.StickyBox: mpm.StickyBox((0.1,), (0.9,), mpm.Motion((0.0, 1.0), ((0.0,), (0.1,)))),
    mpm.SlipBox: mpm.SlipBox((0.1, -np.inf), (np.inf, 0.7)),
    mpm.SeparatingBox: mpm.SeparatingBox((0.1,), (0.9,), friction=0.3),
    mpm.Grip: GRIP,
    mpm.RigidPart: mpm.RigidPart(mpm.Ball((0.1, 0.2), 0.3), (True, False)),
    mpm.SymmetryPlane: mpm.SymmetryPlane(1, 0.05, "below"),
    mpm.ClampPlane: mpm.ClampPlane(1, 0.05, "below", GRIP.motion),
    mpm.ContactPlane: mpm.ContactPlane(1, 0.05, "below", friction=0.3),
    mpm.Bodies: mpm.Bodies(0.3, (0, 1, 0)),
    mpm.Box: mpm.Box((0.0, 0.1, 0.2), (1.0, 1.1, 1.2)),
    mpm.Ball: mpm.Ball((0.1, 0.2), 0.3),
    mpm.HalfSpace: mpm.HalfSpace((0.1, 0.2), (3.0, 4.0)),
    mpm.geometry.Capsule: mpm.geometry.Capsule((0.1, 0.2), (0.3, 0.4), 0.1),
    mpm.geometry.Cylinder: mpm.geometry.Cylinder((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.1),
    mpm.geometry.Annulus: mpm.geometry.Annulus((0.1, 0.2), 0.3, 0.4),
    mpm.geometry.Tube: mpm.geometry.Tube((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.1, 0.2),
    mpm.geometry.Union: mpm.geometry.Union((mpm.Ball((0.1, 0.2), 0.3), mpm.Box((0.0, 0.1), (1.0, 1.1)))),
    mpm.geometry.Intersection: mpm.geometry.Intersection((mpm.Ball((0.1, 0.2), 0.3), mpm.Box((0.0, 0.1), (1.0, 1.1)))),
    mpm.geometry.Complement: mpm.geometry.Complement(mpm.Ball((0.1, 0.2), 0.3)),
    mpm.geometry.Placed: mpm.geometry.Placed(mpm.Ball((0.1, 0.2), 0.3), rotation=0.3, centre=(1.0, 0.0)),
    mpm.geometry.SampledDistance: mpm.geometry.SampledDistance((0.1, 0.2), 0.1, np.linspace(-1, 1, 20).reshape(4, 5)),
    mpm.StickyCollider: mpm.StickyCollider(mpm.Ball((0.1, 0.2), 0.3), GRIP.motion),
    mpm.SlipCollider: mpm.SlipCollider(mpm.HalfSpace((0.1, 0.2), (0.0, 1.0))),
    mpm.SeparatingCollider: mpm.SeparatingCollider(mpm.Ball((0.1,), 0.3), friction=0.2),
    mpm.Traction: mpm.Traction(PATCH, (1.0, 2.0)),
    mpm.Couple: mpm.Couple(PATCH, 3.0),
    mpm.Rigid: mpm.Rigid(1e6, (True, False), turns=False),
    mpm.extensions.Active: mpm.extensions.Active(mpm.NeoHookean(1e5, 0.3), 1e3, 0.1, 0.2),
    mpm.Pressure: mpm.Pressure(PATCH, mpm.TimeSeries((0.0, 1.0), (0.0, 2.0)), following=False),
    mpm.PointLoad: mpm.PointLoad(mpm.PointsAt(((0.1, 0.2), (0.3, 0.4))), (1.0, 2.0)),
    mpm.Spring: mpm.Spring(mpm.PointsAt(((0.1, 0.2),), (1.0,)), (1.0, 2.0), 3.0, GRIP.motion),
    mpm.Patch: PATCH,
    mpm.PointsAt: mpm.PointsAt(((0.1, 0.2), (0.3, 0.4)), (0.25, 0.75)),
    mpm.state.AttachedPoints: mpm.state.AttachedPoints(
        np.zeros((2, 1)),
        np.ones((1, 2)),
        np.ones(1),
        np.full((1, 2), 0.3),
        np.array([[0.0, 1.0]]),
        np.full((2, 1), 0.5),
        np.ones((2, 1, 2)),
    ),
    mpm.TimeSeries: mpm.TimeSeries((0.0, 1.0), ((0.0, 1.0), (2.0, 3.0))),
    mpm.Motion: GRIP.motion,
    mpm.RigidMotion: mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.2)), (0.0, 0.5), (0.3, 0.4)),
    mpm.BSpline: mpm.BSpline(1),
    mpm.SplineGradient: mpm.SplineGradient(),
    mpm.MLSGradient: mpm.MLSGradient(),
    mpm.PIC: mpm.PIC(),
    mpm.FLIP: mpm.FLIP(0.9),
    mpm.APIC: mpm.APIC(),
    mpm.UpdatedLagrangian: mpm.UpdatedLagrangian(),
    mpm.TotalLagrangian: mpm.TotalLagrangian(),
    mpm.Explicit: mpm.Explicit(),
    mpm.SemiImplicit: mpm.SemiImplicit(
        0.5, mpm.implicit.ConjugateResidual(1e-7), hessian=mpm.implicit.JvpHessian(), guess=Guess.EXPLICIT
    ),
    mpm.BackwardEuler: mpm.BackwardEuler(
        mpm.implicit.Newton(rtol=1e-6, max_steps=7), preconditioner=mpm.implicit.DiagonalPreconditioner()
    ),
    mpm.ImplicitMidpoint: mpm.ImplicitMidpoint(
        mpm.implicit.Newton(mpm.implicit.ConjugateResidual(1e-2), 1e-6, 9), guess=Guess.ZERO
    ),
    mpm.TRBDF2: mpm.TRBDF2(0.3, mpm.implicit.Linearised(mpm.implicit.ConjugateResidual(1e-7))),
    mpm.implicit.Linearised: mpm.implicit.Linearised(),
    mpm.implicit.Newton: mpm.implicit.Newton(),
    mpm.implicit.AnalyticHessian: mpm.implicit.AnalyticHessian(),
    mpm.implicit.JvpHessian: mpm.implicit.JvpHessian(),
    mpm.implicit.ConjugateResidual: mpm.implicit.ConjugateResidual(1e-7, increment_rtol=1e-3, max_steps=17),
    mpm.AveragedVolume: mpm.AveragedVolume((0, 1)),
    mpm.extensions.DensityCorrection: mpm.extensions.DensityCorrection(mpm.Box((0.0, 0.1), (1.0, 1.1)), 2.0, 0.1),
    mpm.implicit.DiagonalPreconditioner: mpm.implicit.DiagonalPreconditioner(),
    mpm.implicit.MassPreconditioner: mpm.implicit.MassPreconditioner(),
    mpm.extensions.VolumePreconditioner: mpm.extensions.VolumePreconditioner(1000, extent=(5, 6)),
}
"""One of each class that files hold; the next test says so."""


@pytest.fixture(autouse=True)
def _no_class_of_ones_own(monkeypatch):
    """Other tests register some."""
    monkeypatch.setattr(_schema, "_registered", {})


def assert_same(a: object, b: object) -> None:
    """The same tree with the same numbers to the last bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype


def test_every_class_has_an_example():
    """A class that is registered is a class that is tested."""
    assert set(EXAMPLES) == set(saved_classes())


@pytest.mark.parametrize("value", **ids({c.__name__: value for c, value in EXAMPLES.items()}))
def test_objects_come_back_from_json(value):
    """decode(encode(a)) = a, through JSON text, whether or not the class is known beforehand."""
    data = json.loads(json.dumps(encode(value)))
    assert_same(decode(data, type(value)), value)
    assert_same(decode(data, type(value).__mro__[1]), value)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numbers_keep_every_bit(dtype):
    """Floats of all magnitudes survive text."""
    bits = np.random.default_rng(0).integers(0, 2**62, 60).astype(np.uint64)
    a = np.abs(bits.view(np.float64) if dtype == np.float64 else (bits % 2**31).astype(np.uint32).view(np.float32))
    a = np.where(np.isfinite(a) & (a > 0), a, np.finfo(dtype).smallest_subnormal)
    law = decode(json.loads(json.dumps(encode(mpm.FixedCorotated(jnp.asarray(a), 0.3)))), mpm.FixedCorotated)
    assert np.array_equal(np.asarray(law.youngs_modulus).astype(dtype), a)


def test_large_arrays_are_put_aside():
    """More than 64 numbers go to the side, under their path, and come back with their dtype."""
    moduli, times = np.linspace(1, 2, 65, dtype=np.float32), np.linspace(0, 1, 100)
    motion = mpm.Motion(times, np.zeros((100, 2)))
    scene = mpm.Scene(GRID, mpm.NeoHookean(moduli, 0.3), boundary=mpm.Grip(mpm.Ball((0.0, 0.0), 1.0), motion))
    arrays: dict = {}
    data = encode(scene, arrays)
    assert set(arrays) == {"material.youngs_modulus", "boundary.0.motion.times", "boundary.0.motion.displacement"}
    assert data["material"]["youngs_modulus"] == {"array": "material.youngs_modulus"}
    assert_same(decode(json.loads(json.dumps(data)), mpm.Scene, "", arrays), scene)
    assert_same(decode(encode(scene), mpm.Scene).boundary, scene.boundary)  # written out, an array is read as one
    with pytest.raises(ValueError, match=r"\[material\] youngs_modulus refers to the array 'gone', which is not there"):
        decode({**data, "material": {**data["material"], "youngs_modulus": {"array": "gone"}}}, mpm.Scene, "", arrays)


def test_toml_may_leave_out_defaults_and_evident_kinds():
    """A scene needs no more text than it has content; whole numbers stand for floats."""
    text = """
        gravity = [0, -10]
        transfer = "PIC"
        grid = {shape = [8, 8], spacing = 1}
        [material]
        kind = "NeoHookean"
        youngs_modulus = 100000
        poisson_ratio = 0.3
        [[boundary]]
        kind = "Grip"
        region = {kind = "Box", lower = [-inf, 0], upper = [1, 1]}
        motion = {times = [0, 1], displacement = [[0, 0], [1, 0.5]]}
    """
    grip = mpm.Grip(mpm.Box((-np.inf, 0.0), (1.0, 1.0)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (1.0, 0.5))))
    scene = mpm.Scene(
        mpm.Grid((8, 8), 1.0), mpm.NeoHookean(1e5, 0.3), gravity=(0.0, -10.0), boundary=grip, transfer=mpm.PIC()
    )
    assert_same(decode(tomllib.loads(text), mpm.Scene), scene)


def test_numbers_of_files_are_finite_but_for_corners(monkeypatch):
    """By their annotation, in a class of one's own too, and not by the argument's name."""
    monkeypatch.setattr(_schema, "_registered", {})

    @mpm.register
    class Slab(mpm.Box):
        edge: mpm.geometry.Corner | None = None
        upwards: tuple[float, ...] = (0.0, 1.0)

    data = {"kind": "Slab", "lower": [0, 0], "upper": [1, float("inf")], "edge": [0, float("-inf")]}
    assert decode(data, AbstractRegion).edge == (0.0, -np.inf)
    for key in ("upper", "edge"):
        with pytest.raises(ValueError, match=f"{key} must be finite"):
            decode(data | {key: [0, float("nan")]}, AbstractRegion)
    with pytest.raises(ValueError, match="upwards must be finite"):
        decode(data | {"upwards": [0, float("inf")]}, AbstractRegion)
    samples = {"kind": "SampledDistance", "lower": [float("-inf")], "spacing": 0.1, "values": [-2, -1, 0, 1, 2]}
    with pytest.raises(ValueError, match="lower must be finite"):
        decode(samples, AbstractRegion)


DISK = mpm.Ball((0.3, 0.4), 0.2)
NESTED = mpm.geometry.Union(
    (DISK, mpm.geometry.Union((mpm.HalfSpace((0.0, 0.1), (0.0, 1.0)), mpm.Box((0.1, 0.1), (0.2, 0.3)))))
)
SLIDE = mpm.Motion((0.0, 0.5), ((0.0, 0.0), (0.1, 0.0)))
TURN = mpm.RigidMotion((0.0, 0.5), ((0.0, 0.0), (0.1, 0.0)), (0.0, 1.5), (0.3, 0.4))
SPIN = mpm.RigidMotion((0.0, 0.5), ((0.0,) * 3, (0.1, 0.0, 0.0)), ((0.0,) * 3, (0.0, 1.5, 0.0)), (0.3, 0.4, 0.5))
BODIES = {
    "ball that slides": (
        'kind = "StickyCollider"\nshape = { kind = "Ball", centre = [0.3, 0.4], radius = 0.2 }\n'
        'motion = { kind = "Motion", times = [0, 0.5], displacement = [[0, 0], [0.1, 0]] }',
        mpm.StickyCollider(DISK, SLIDE),
    ),
    "half-space": (
        'kind = "SlipCollider"\nshape = { kind = "HalfSpace", point = [0.0, 0.1], normal = [0.0, 1.0] }',
        mpm.SlipCollider(NESTED.regions[1].regions[0]),
    ),
    "nested union that turns": (
        """kind = "SeparatingCollider"
        friction = 0.3
        motion = { kind = "RigidMotion", times = [0, 0.5], displacement = [[0, 0], [0.1, 0]], \
            rotation = [0, 1.5], centre = [0.3, 0.4] }
        [boundary.shape]
        kind = "Union"
        [[boundary.shape.regions]]
        kind = "Ball"
        centre = [0.3, 0.4]
        radius = 0.2
        [[boundary.shape.regions]]
        kind = "Union"
        regions = [
            { kind = "HalfSpace", point = [0.0, 0.1], normal = [0.0, 1.0] },
            { kind = "Box", lower = [0.1, 0.1], upper = [0.2, 0.3] },
        ]""",
        mpm.SeparatingCollider(NESTED, TURN, friction=0.3),
    ),
    "union of one": (
        'kind = "SlipCollider"\n[boundary.shape]\nkind = "Union"\n'
        'regions = { kind = "Ball", centre = [0.3, 0.4], radius = 0.2 }',
        mpm.SlipCollider(mpm.geometry.Union(DISK)),
    ),
    "pot that leans": (
        """kind = "SlipCollider"
        [boundary.shape]
        kind = "Placed"
        rotation = 0.3
        mirror = [1, 0]
        centre = [0.3, 0.4]
        region = { kind = "Complement", region = { kind = "Intersection", regions = [
            { kind = "Ball", centre = [0.3, 0.4], radius = 0.2 }, { kind = "Box", lower = [0, -inf], upper = [1, 0.5] },
        ] } }""",
        mpm.SlipCollider(
            mpm.geometry.Placed(
                mpm.geometry.Complement(
                    mpm.geometry.Intersection((DISK, mpm.Box((0.0, -np.inf), (1.0, 0.5)))),
                ),
                mirror=(1.0, 0.0),
                rotation=0.3,
                centre=(0.3, 0.4),
            )
        ),
    ),
    "capsule": (
        'kind = "SeparatingCollider"\nshape = { kind = "Capsule", start = [0, 0], end = [0.5, 0.5], radius = 0.1 }',
        mpm.SeparatingCollider(mpm.geometry.Capsule((0.0, 0.0), (0.5, 0.5), 0.1)),
    ),
    "annulus": (
        'kind = "SlipCollider"\nshape = { kind = "Annulus", centre = [0, 0], inner = 0.1, outer = 0.2 }',
        mpm.SlipCollider(mpm.geometry.Annulus((0.0, 0.0), 0.1, 0.2)),
    ),
    "tube": (
        'kind = "SlipCollider"\nshape = { kind = "Tube", start = [0, 0, 0], end = [0, 0, 1], inner = 1, outer = 2 }',
        mpm.SlipCollider(mpm.geometry.Tube((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 2.0)),
    ),
    "samples": (
        'kind = "SlipCollider"\n'
        'shape = { kind = "SampledDistance", lower = [0, 0], spacing = 0.5, values = [' + 4 * "[-1, 0, 1, 2]," + "] }",
        mpm.SlipCollider(mpm.geometry.SampledDistance((0.0, 0.0), 0.5, np.array([[-1.0, 0.0, 1.0, 2.0]] * 4))),
    ),
    "cylinder that spins": (
        """kind = "StickyCollider"
        shape = { kind = "Cylinder", start = [0, 0, 0], end = [0, 0, 1], radius = 0.2 }
        [boundary.motion]
        kind = "RigidMotion"
        times = [0, 0.5]
        displacement = [[0, 0, 0], [0.1, 0, 0]]
        rotation = [[0, 0, 0], [0, 1.5, 0]]
        centre = [0.3, 0.4, 0.5]""",
        mpm.StickyCollider(mpm.geometry.Cylinder((0.0,) * 3, (0.0, 0.0, 1.0), 0.2), SPIN),
    ),
}


@pytest.mark.parametrize(("text", "expected"), **ids(BODIES))
def test_toml_holds_every_collider_shape_and_motion(text, expected):
    """As whole scenes, which say the same as the constructors do."""
    head = f"""
        grid = {{ shape = {[8] * expected.dim}, spacing = 0.1 }}
        material = {{ kind = "NeoHookean", youngs_modulus = 1e5, poisson_ratio = 0.3 }}
        [[boundary]]
        """
    scene = decode(tomllib.loads(head + text), mpm.Scene)
    assert_same(scene.boundary[0], expected)
    assert_same(decode(json.loads(json.dumps(encode(scene))), mpm.Scene), scene)


def test_the_bodies_are_of_every_kind():
    """Every collider, shape and motion stands in a file above."""
    named = {word for text, _ in BODIES.values() for word in text.split('"')}
    bodies = {c.__name__ for c in saved_classes() if issubclass(c, (AbstractCollider, AbstractRegion, AbstractMotion))}
    assert bodies - named == set()


def test_a_function_takes_its_arguments_from_a_table():
    """What `fill` is called with can be read like an object."""
    table = {"region": {"kind": "Ball", "centre": [0, 0], "radius": 1}, "density": 1000, "particles_per_cell": [2, 3]}
    given = arguments(mpm.fill, table, "[particles]", without=("grid",))
    assert given["particles_per_cell"] == (2, 3)
    assert isinstance(given["region"], mpm.Ball)
    with pytest.raises(
        ValueError, match=r"^\[particles\]: unknown key 'grid'\. Known here: region, particles_per_cell"
    ):
        arguments(mpm.fill, {**table, "grid": 1}, "[particles]", without=("grid",))
    with pytest.raises(ValueError, match=r"^\[particles\] needs the key 'density'\.$"):
        arguments(mpm.fill, {"region": table["region"]}, "[particles]", without=("grid",))


def test_a_class_of_ones_own_is_refused():
    """A law that the schema does not know cannot be written, and the error says which object it is."""

    class Wood(mpm.FixedCorotated):
        """Not the package's own, though it inherits from it."""

    with pytest.raises(ValueError, match=r"^material is a Wood, which files cannot hold: .*own classes"):
        encode(mpm.Scene(GRID, Wood(1e5, 0.3)))


def edited(**changes: object) -> dict:
    """A valid scene table with keys set at dotted paths (two underscores for a dot), or removed by None."""
    scene = {
        "grid": {"shape": [8, 8], "spacing": 0.1},
        "material": {"kind": "FixedCorotated", "youngs_modulus": 1e5, "poisson_ratio": 0.3},
        "boundary": [
            {"kind": "SlipBox", "lower": [0, 0], "upper": [1, 1]},
            {
                "kind": "Grip",
                "region": {"kind": "Box", "lower": [0, 0], "upper": [1, 1]},
                "motion": {"times": [0, 1], "displacement": [[0, 0], [1, 0]]},
            },
        ],
    }
    for path, value in changes.items():
        *parents, key = path.split("__")
        table: dict = scene
        for parent in parents:
            table = table[int(parent) if parent.isdigit() else parent]  # type: ignore[index]
        if value is None:
            del table[key]
        else:
            table[key] = value
    return scene


DISC = {"kind": "Ball", "centre": [0, 0], "radius": 1}
TURNS = {"kind": "RigidMotion", "times": [0, 1], "displacement": [[0, 0], [1, 0]], "centre": [0, 0]}
ERRORS = [
    (
        {"gravty": [0, 0]},
        "Unknown key 'gravty', did you mean 'gravity'? Known here: grid, material, gravity, boundary,",
    ),
    ({"grid": None}, "The file needs the key 'grid'."),
    (
        {"body_force": {"kind": "Wind"}},
        "[body_force]: unknown kind 'Wind'. It must be a class of your own. A class of your own is known when the "
        "module is imported that calls mpm.register.",
    ),
    ({"grid": 3}, "grid must be a table with a kind, Grid, got 3."),
    ({"grid__shape": [8.5, 8]}, "[grid] shape must be a list of whole numbers, got [8.5, 8]."),
    ({"grid__shape": 8}, "[grid] shape must be a list of whole numbers, got 8."),
    ({"grid__shape": [True, 8]}, "[grid] shape must be a list of whole numbers, got [True, 8]."),
    ({"grid__spacing": [0.1]}, "[grid] spacing must be a number, got [0.1]."),
    ({"grid__spacing": 10**400}, "[grid] spacing must be finite, got 1000"),
    ({"grid__spacing": -1}, "[grid]: Grid's spacing [m] must be greater than zero, got -1.0."),
    ({"grid__follow": 1}, "[grid] follow must be true or false, got 1."),
    ({"grid__kind": "Gird"}, "[grid]: unknown kind 'Gird', did you mean 'Grid'? It must be Grid."),
    ({"material__kind": None}, "[material] needs a kind: one of Active, CamClay, DruckerPrager, FixedCorotated, "),
    (
        {"material__kind": "Neohookean"},
        "[material]: unknown kind 'Neohookean', did you mean 'NeoHookean'? It must be one",
    ),
    (
        {"material__kind": 7},
        "[material]: unknown kind 7. It must be one of Active, CamClay, DruckerPrager, FixedCorotated, ",
    ),
    ({"material__kind": "Box"}, "[material]: unknown kind 'Box'. It must be one of Active, CamClay, DruckerPrager, Fi"),
    ({"material__youngs_modulu": 1}, "[material]: unknown key 'youngs_modulu', did you mean 'youngs_modulus'? Known"),
    ({"material__poisson_ratio": None}, "[material] needs the key 'poisson_ratio'."),
    (
        {"material__poisson_ratio": 0.7},
        "[material]: FixedCorotated's poisson_ratio must be strictly between -1 and 0.5",
    ),
    (
        {"material__youngs_modulus": "soft"},
        "[material] youngs_modulus must be a number or a list of numbers, got 'soft'.",
    ),
    ({"material__youngs_modulus": float("nan")}, "[material] youngs_modulus must be finite, got nan."),
    ({"material__youngs_modulus": True}, "[material] youngs_modulus must be a number or a list of numbers, got True."),
    (
        {"material__youngs_modulus": {"array": "x"}},
        "[material] youngs_modulus must be a number or a list of numbers, got",
    ),
    ({"gravity": [0, float("inf")]}, "gravity must be finite, got [0, inf]."),
    ({"gravity": [0, 0, 0]}, "gravity must have 2 components, got (0.0, 0.0, 0.0)."),
    (
        {"boundary": 3},
        "boundary must be a table with a kind, one of ClampPlane, ContactPlane, Grip, RigidPart, SeparatingBox, ",
    ),
    ({"boundary": ["Sticky"]}, "[boundary] 1: unknown kind 'Sticky', did you mean 'StickyBox'? It must be one of"),
    ({"boundary__0__lower": [float("nan"), 0]}, "[[boundary]] 1 lower must be finite, got [nan, 0]."),
    ({"boundary__0__lower": [2, 0]}, "[[boundary]] 1: SlipBox's lower corner must lie below its upper one"),
    ({"boundary__1__axes": [1, 0]}, "[[boundary]] 2 axes must be a list of true and false, got [1, 0]."),
    (
        {"boundary__1__region__lower": [[0, 0]]},
        "[[boundary]] 2 [region] lower must be a list of numbers, got [[0, 0]].",
    ),
    ({"boundary__1__motion__times": [1, 0]}, "[[boundary]] 2 [motion]: A motion's times must increase"),
    (
        {"boundary__1__motion__displacement": [[0, 0], [1]]},
        "[[boundary]] 2 [motion] displacement must be a list of lists of numbers, got [[0, 0], [1]].",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": {"kind": "Bal"}}]},
        "[[boundary]] 1 [shape]: unknown kind 'Bal', did you mean 'Ball'? It must be one of Annulus, Ball, Box, Caps",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": {"kind": "Ball", "centre": [0, 0], "radius": -1}}]},
        "[[boundary]] 1 [shape]: Ball's radius [m] must be greater than zero, got -1.0.",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": {"kind": "Union", "regions": [DISC, {"kind": "Box"}]}}]},
        "[[boundary]] 1 [[shape.regions]] 2 needs the key 'lower'.",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": DISC, "motion": {**TURNS, "rotation": [0]}}]},
        "[[boundary]] 1 [motion]: A rigid motion's rotation must have shape (2,) here, got (1,).",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": DISC, "motion": {"times": [0]}}]},
        "[[boundary]] 1 [motion] needs the key 'displacement'.",
    ),
    (
        {"boundary": [{"kind": "SlipCollider", "shape": {**DISC, "centre": [0, 0, 0]}}]},
        "SlipCollider must have 2 coordinates, as the grid has, got 3.",
    ),
    ({"material": []}, "A scene needs at least one law, got none."),
    ({"material": [{"kind": "NeoHookean"}]}, "[[material]] 1 needs the key 'youngs_modulus'."),
    (
        {"material": [{"kind": "NeoHookean", "youngs_modulus": 1, "poisson_ratio": 0.3}, {"kind": "Snoww"}]},
        "[[material]] 2: unknown kind 'Snoww', did you mean 'Snow'? It must be one of Active, CamClay, DruckerPrager,",
    ),
    ({"transfer": "PICK"}, "transfer: unknown kind 'PICK', did you mean 'PIC'? It must be one of APIC, FLIP, PIC."),
    ({"kernel": {"order": 4}}, "[kernel]: BSpline's order must be from 1 to 3, got 4."),
]


@pytest.mark.parametrize(("changes", "message"), ERRORS, ids=[message[:40] for _, message in ERRORS])
def test_a_wrong_scene_gets_one_line_that_names_the_place(changes, message):
    """Place, what must hold, what was got."""
    assert isinstance(decode(edited(), mpm.Scene), mpm.Scene)
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the whole line is compared)
        decode(edited(**changes), mpm.Scene)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            {"kind": "SemiImplicit", "guess": "v"},
            "[method] guess must be one of 'grid velocity', 'explicit', 'zero', got 'v'.",
        ),
        ({"kind": "SemiImplicit", "beta": 2}, "[method]: SemiImplicit's beta must be from 0 to 1, got 2.0."),
        (
            {"kind": "SemiImplicit", "solver": {"max_steps": 1.5}},
            "[method.solver] max_steps must be a whole number, got 1.5.",
        ),
        ({"kind": "SemiImplicit", "solver": {"rtol": -1}}, "[method.solver]: ConjugateResidual's rtol must be greater"),
        (
            "Implicit",
            "[method]: unknown kind 'Implicit', did you mean 'SemiImplicit'? It must be one of BackwardEuler, Exp",
        ),
    ],
)
def test_a_wrong_method_gets_one_line_that_names_the_place(table, message):
    """Nested tables are named by their header."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        decode(table, AbstractIntegrator, "[method]")
    assert str(caught.value).startswith(message)
