"""One step: against an independent oracle, and what it conserves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DESCRIPTIONS,
    GRADIENTS,
    KERNELS,
    LAWS,
    TRANSFERS,
    assert_close,
    block,
    cloud,
    explicit_limit,
    ids,
    thorough,
)
from numpy_oracle import numpy_step

import mpmjax as mpm

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
STICKY = mpm.StickyBox((0.1, -np.inf, 0.05), (np.inf, 0.5, np.inf))
SLIP = mpm.SlipBox((0.1, -np.inf, 0.05), (0.45, 0.5, np.inf))

GRIP = mpm.Grip(mpm.Box((0.15, 0.15), (0.45, 0.35)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.8, -0.5))))


def case(d, description, gradient, transfer, law, wall, p=50, order=2):
    """A random cloud in a scene of the named choices, with a wall through it and a material of its own a particle."""
    grid, particles = cloud(d, p=p, cells=2 if d == 3 else 6)
    rng = np.random.default_rng(7)
    law = type(LAWS[law])(jnp.asarray(rng.uniform(0.5e4, 2e4, p)), jnp.asarray(rng.uniform(0.1, 0.4, p)))
    scene = mpm.Scene(
        grid,
        law,
        gravity=(1.0, -9.81, 3.0)[:d],
        boundary=wall if wall is GRIP else type(wall)(wall.lower[:d], wall.upper[:d]),
        kernel=mpm.BSpline(order),
        gradient=GRADIENTS[gradient],
        transfer=TRANSFERS[transfer],
        description=DESCRIPTIONS[description],
    )
    return scene, mpm.prepare(scene, particles)


def assert_same(new, expected, rtol):
    """Every evolving field agrees."""
    for name, value in expected.items():
        if value is not None:
            assert_close(getattr(new, name), value, rtol)


ORACLE_CASES = [
    (3, "updated", "spline", "apic", "fixed_corotated", SLIP),
    (1, "updated", "mls", "apic", "neo_hookean", STICKY),
    *thorough(
        ((2, "total", "mls", "pic", "fixed_corotated", GRIP),),
        ((2, "updated", "mls", "apic", "fixed_corotated", STICKY),),
        ((2, "total", "spline", "apic", "neo_hookean", SLIP),),
        ((2, "updated", "spline", "flip", "neo_hookean", SLIP),),
    ),
]


@pytest.mark.parametrize("choices", ORACLE_CASES, ids=lambda c: "-".join(map(str, c[:5])))
def test_explicit_step_agrees_with_numpy_and_with_itself_uncompiled(choices):
    """jit = eager = the formulas, on 50 particles."""
    scene, particles = case(*choices)
    dt = 1e-3
    expected = numpy_step(scene, particles, dt)
    assert_same(mpm.step(scene, particles, 0.0, dt)[0], expected, 1e-12)
    if choices[0] == 2:
        with jax.disable_jit():
            assert_same(mpm.step(scene, particles, 0.0, dt)[0], expected, 1e-12)


SEMI_IMPLICIT_CASES = [
    (1, "updated", "spline", "pic", "neo_hookean", STICKY, 0.75),
    *thorough(
        ((2, "updated", "mls", "apic", "fixed_corotated", STICKY, 1.0),),
        ((2, "total", "spline", "flip", "neo_hookean", GRIP, 0.5),),
    ),
]


@pytest.mark.parametrize("choices", SEMI_IMPLICIT_CASES, ids=lambda c: "-".join(map(str, c[:5])))
def test_semi_implicit_step_agrees_with_numpy_and_with_itself_uncompiled(choices):
    """jit = eager = H assembled by columns and solved densely, on 50 particles at twice the explicit limit."""
    *choices, beta = choices
    scene, particles = case(*choices)
    dt, method = 0.03, mpm.SemiImplicit(beta=beta, solver=TIGHT)
    expected = numpy_step(scene, particles, dt, beta)
    new, info = mpm.step(scene, particles, 0.0, dt, method=method)
    assert info.solve.converged
    assert info.solve.iterations > 5
    assert_same(new, expected, 1e-9)
    if choices[2] == "mls":
        with jax.disable_jit():
            assert_same(mpm.step(scene, particles, 0.0, dt, method=method)[0], expected, 1e-9)


METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-13)),
}


@pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
def test_free_fall_is_exact(method):
    """y_n = y0 + n v0 dt + n(n+1)/2 g dt², over many windows' heights."""
    n, dt, g = 100, 1e-2, -9.81
    grid = mpm.Grid((8, 8), 0.1, follow=True)
    ball = mpm.fill(mpm.Ball((0.2, 0.3), 0.11), grid, density=1e3, velocity=(0.5, 1.0))
    final = mpm.rollout(mpm.Scene(grid, LAWS["neo_hookean"], gravity=(0.0, g)), ball, steps=n, dt=dt, method=method)
    fallen = np.array([n * 0.5 * dt, n * 1.0 * dt + n * (n + 1) / 2 * g * dt**2])
    assert_close(final.x, ball.x + fallen, 1e-12)
    assert_close(final.v, np.broadcast_to([0.5, 1.0 + n * g * dt], final.v.shape), 1e-12)


@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in ("explicit", "semi_implicit")}, ()))
def test_a_shift_by_whole_spacings_changes_nothing(method):
    """The frame's place on the lattice does not matter, whether the window is moved by hand or follows."""
    shift, dx = np.array([5, -3]), 0.125
    _, particles = cloud(2, dx=dx)
    moved = mpm.Particles(
        particles.x + shift * dx, *(getattr(particles, k) for k in ("v", "mass", "volume", "deformations", "C"))
    )

    def advanced(particles, by, **window):
        floor = mpm.SlipBox((-np.inf, 0.125 + by[1] * dx), (np.inf, np.inf))
        scene = mpm.Scene(
            mpm.Grid((16, 16), dx, **window), LAWS["fixed_corotated"], gravity=(0.0, -9.81), boundary=floor
        )
        return mpm.step(scene, particles, 0.0, 5e-3, method=method)[0]

    here = advanced(particles, (0, 0), origin=(-4, -4))
    for there in (
        advanced(moved, shift, origin=(-4 + 5, -4 - 3)),
        advanced(moved, shift, follow=True),
    ):
        assert_close(there.x - shift * dx, here.x, 1e-13)
        for name in ("v", "F", "C"):
            assert_close(getattr(there, name), getattr(here, name), 1e-13)


def angular_momentum(particles, moment):
    """Σ m (x ⊗ v − v ⊗ x) + m D (Cᵀ − C), a skew matrix."""
    x, v, m = (np.asarray(a) for a in (particles.x, particles.v, particles.mass))
    orbital = np.einsum("p,pa,pb->ab", m, x, v)
    if particles.C is not None:
        orbital += moment * np.einsum("p,pba->ab", m, np.asarray(particles.C))
    return orbital - orbital.T


def spinning_block(d, **scene):
    """A block that spins, is stretched and drifts, far from walls."""
    scene, particles = block(d, side=2, **scene)
    scene = eqx.tree_at(lambda s: s.grid, scene, mpm.Grid((10,) * d, scene.grid.spacing, origin=(-4,) * d))
    spin = np.random.default_rng(3).normal(size=(d, d))
    arm = np.asarray(particles.x) - 0.1
    v = arm @ (3 * (spin - spin.T) + 0.5 * spin).T + 0.1
    return scene, mpm.prepare(scene, mpm.Particles(particles.x, jnp.asarray(v), particles.mass, particles.volume))


@pytest.mark.parametrize(
    ("d", "kernel", "gradient"),
    [(2, "quadratic", "mls"), *thorough((2, "quadratic", "spline"), (2, "cubic", "mls"), (3, "quadratic", "mls"))],
)
def test_explicit_apic_conserves_linear_and_angular_momentum(d, kernel, gradient):
    """To rounding, over 100 steps."""
    scene, particles = spinning_block(d, kernel=KERNELS[kernel], gradient=GRADIENTS[gradient])
    moment = scene.grid.spacing**2 * {"quadratic": 1 / 4, "cubic": 1 / 3}[kernel]
    final = mpm.rollout(scene, particles, steps=100, dt=0.2 * explicit_limit(scene))
    mpm.prepare(scene, final)  # all are in the window still
    assert np.abs(np.asarray(final.F) - np.eye(d)).max() > 0.05
    assert_close(final.mass @ final.v, particles.mass @ particles.v, 1e-12)
    assert_close(angular_momentum(final, moment), angular_momentum(particles, moment), 1e-12)


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "updated"))
@pytest.mark.parametrize("transfer", **ids(TRANSFERS))
def test_explicit_step_conserves_linear_momentum(transfer, description):
    """PIC, FLIP and APIC, in both descriptions."""
    scene, particles = spinning_block(2, transfer=transfer, description=description)
    final = mpm.rollout(scene, particles, steps=100, dt=0.2 * explicit_limit(scene))
    mpm.prepare(scene, final)  # all are in the window still
    assert np.abs(np.asarray(final.v - particles.v)).max() > 0.1
    assert_close(final.mass @ final.v, particles.mass @ particles.v, 1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("contrast", [1e6, 1e12])
@pytest.mark.parametrize("gradient", **ids(GRADIENTS))
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_light_body_flies_as_freely_as_a_heavy_one(dtype, gradient, contrast):
    """Its velocity, and what it owes to its first, after 100 steps beside a body heavier by the contrast."""
    grid = mpm.Grid((20, 10), 0.1, origin=(-2, -2))
    boxes = mpm.Box((0.03, 0.04), (0.33, 0.34)), mpm.Box((1.03, 0.04), (1.33, 0.34))
    pair = [
        mpm.fill(place, grid, particles_per_cell=4, density=rho)
        for place, rho in zip(boxes, (1e3, 1e3 / contrast), strict=True)
    ]
    particles = jax.tree.map(lambda a: a.astype(dtype), mpm.join(*pair))
    laws = [mpm.NeoHookean(stiffness, 0.3) for stiffness in (1e4, 1e4 / contrast)]
    scene, light, speed = mpm.Scene(grid, laws, gradient=gradient), pair[0].count, jnp.asarray([-0.1, 0.2], dtype)

    def final(speed):
        moving = eqx.tree_at(lambda q: q.v, particles, particles.v.at[light:].set(speed))
        v = mpm.rollout(scene, moving, steps=100, dt=2e-3).v[light:]
        return v.mean(axis=0), v

    slope, v = jax.jacfwd(final, has_aux=True)(speed)
    rounding = 100 * float(jnp.finfo(dtype).eps)
    assert_close(v, np.broadcast_to(speed, v.shape), rounding)
    assert_close(slope, np.eye(2), rounding)


@pytest.mark.parametrize(
    ("d", "description", "dtype"),
    [
        (2, "updated", jnp.float64),
        *thorough((2, "total", jnp.float64), (3, "updated", jnp.float64), (2, "updated", jnp.float32)),
    ],
)
def test_particles_on_nodes_of_the_linear_kernel_read_no_empty_node(d, description, dtype):
    """An angle of two blocks on the nodes of one direction: that flies as a whole stays undeformed, and strained at
    random keeps its momentum."""
    grid, dx = mpm.Grid((9,) * d, 0.25), 0.25
    places = np.stack(np.meshgrid(*[np.arange(3)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    places = places[(places[:, 0] < 2) | (places[:, 1] < 1)]
    x = dx * (places + 3 + np.array([0.0, 0.3, 0.0])[:d])
    ones = jnp.ones(len(x), dtype)
    v = jnp.broadcast_to(jnp.array([1.0, -0.5, 0.3][:d], dtype), x.shape)
    body = mpm.Particles(x=jnp.asarray(x, dtype), v=v, mass=ones, volume=dx**d * ones)
    scene = mpm.Scene(grid, LAWS["neo_hookean"], kernel=mpm.BSpline(1), description=DESCRIPTIONS[description])
    body = mpm.prepare(scene, body)
    flown, _ = mpm.step(scene, body, 0.0, 5e-3)
    few = 20 * float(jnp.finfo(dtype).eps)
    assert_close(flown.F, body.F, few)
    assert_close(flown.v, body.v, few)
    strain = 0.05 * jax.random.normal(jax.random.key(0), body.F.shape, dtype)
    strained = eqx.tree_at(lambda q: q.deformations[0], body, body.F + strain)
    pushed, _ = mpm.step(scene, strained, 0.0, 5e-4)
    change = pushed.v - body.v
    assert_close(change.sum(axis=0), jnp.zeros(d), 0, few * float(jnp.abs(change).sum()))


@pytest.mark.parametrize("dt", [0.0, -1e-3, np.nan])
def test_a_step_must_be_positive(dt):
    """dt is refused with its value."""
    scene, particles = block(2)
    with pytest.raises(ValueError, match=r"dt \[s\]"):
        mpm.step(scene, particles, 0.0, dt)


@pytest.mark.thorough
def test_a_loop_of_checkpointed_steps_holds_a_fraction_of_the_memory():
    """As the help of `step` says; the derivative is the same."""
    grid = mpm.Grid((12, 12), 0.05)
    block = mpm.fill(mpm.Box((0.2, 0.2), (0.4, 0.4)), grid, density=1e3)
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -9.81))
    block = eqx.tree_at(lambda q: q.v, mpm.prepare(scene, block), block.x - 0.3)

    def stretched(stiffness, wrap):
        stiff = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
        body = wrap(lambda particles, t: (mpm.step(stiff, particles, t, 1e-3)[0], None))
        return (jax.lax.scan(body, block, 1e-3 * jnp.arange(50.0))[0].x ** 2).sum()

    plain, kept = (
        jax.jit(jax.grad(lambda E, wrap=wrap: stretched(E, wrap))).lower(1e5).compile()
        for wrap in (lambda body: body, jax.checkpoint)
    )
    assert kept.memory_analysis().temp_size_in_bytes < 0.5 * plain.memory_analysis().temp_size_in_bytes
    np.testing.assert_allclose(kept(1e5), plain(1e5), rtol=1e-9)
