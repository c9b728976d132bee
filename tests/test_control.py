"""Controls: what a policy changes in each step, what enters and leaves; derivatives, files, faults."""

import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, TRANSFERS, assert_close, block, ids, thorough
from matplotlib import pyplot as plt

import mpmjax as mpm
from mpmjax.extensions import Active, Controls, Inlet, Outlet
from mpmjax.verification import check_law
from mpmjax.viz._render import _flat_canvas, _solid_canvas

DT = 2e-3
MUSCLE = Active(LAWS["neo_hookean"], 2e3, angle=np.arctan2(4, 3))
GRIP = mpm.Grip(mpm.Box((-1.0, -1.0), (0.05, 1.0)), mpm.geometry.still(2))


class Policy(eqx.Module):
    """Accelerates, moves a grip and contracts a muscle, by how the body moves and by what it remembers."""

    gain: jax.Array

    def __call__(self, scene, particles, t, dt, memory):
        push, force, squeeze = self.gain * (1 + particles.v[:, 0].mean()) * jnp.cos(30 * t)
        shift = memory["shift"] + dt * push
        motion = mpm.Motion(jnp.stack([t, t + dt]), jnp.stack([memory["shift"], shift]))
        acceleration = (force, memory["mean"])
        scene = eqx.tree_at(lambda s: (s.gravity, s.boundary[0].motion), scene, (acceleration, motion))
        particles = eqx.tree_at(lambda q: q.history.activation, particles, jnp.full(particles.count, squeeze**2))
        return scene, particles, {"shift": shift, "mean": 0.9 * memory["mean"] + particles.x[:, 1].mean()}


START = {"shift": np.zeros(2), "mean": 0.0}
GAIN = jnp.asarray([0.3, 2.0, 0.8])


def walker(gain=GAIN, **options):
    options = {"material": MUSCLE, "boundary": GRIP} | options
    scene, particles = block(2, **options)
    return scene, particles, {"control": Policy(gain), "memory": START}


@pytest.fixture(scope="module")
def whole():
    scene, particles, of = walker()
    return mpm.simulate(scene, particles, t1=12 * DT, dt=DT, save_every=4, **of)


def test_a_control_acts_as_in_a_loop_over_steps_written_out(whole):
    scene, particles, of = walker()
    particles, memory = mpm.prepare(scene, particles), jax.tree.map(jnp.asarray, START)
    step = eqx.filter_jit(lambda scene, q, t: mpm.step(scene, q, t, DT)[0])
    for n in range(12):
        seen, particles, memory = of["control"](scene, particles, n * DT, DT, memory)
        particles = step(seen, particles, jnp.asarray(n * DT))
    assert_close(whole.final.x, particles.x)
    assert_close(whole.final.F, particles.F)
    assert_close(whole.final.history.activation, particles.history.activation)
    jax.tree.map(assert_close, whole.final_memory, memory)
    jax.tree.map(lambda a, b: assert_close(a[-1], b), whole.memory, memory)
    assert float(jnp.abs(whole.final.x - walker()[1].x).max()) > 1e-3
    rolled = mpm.rollout(scene, walker()[1], steps=12, dt=DT, **of)
    assert_close(whole.final.x, rolled.x)


@pytest.mark.parametrize("method", [mpm.Explicit(), *thorough(mpm.SemiImplicit(), mpm.BackwardEuler())])
def test_a_control_that_changes_nothing_changes_no_bit(method):
    scene, particles = block(2, gravity=(0.0, -9.81), boundary=GRIP)
    free = mpm.simulate(scene, particles, t1=6 * DT, dt=DT, method=method)
    idle = mpm.simulate(scene, particles, t1=6 * DT, dt=DT, method=method, control=lambda s, q, t, dt, m: (s, q, m))
    jax.tree.map(np.testing.assert_array_equal, free.final, idle.final)


@pytest.mark.parametrize("dtype", [jnp.float32, *thorough(jnp.float64)])
def test_a_control_acts_in_the_total_description_and_in_single_precision(dtype):
    scene, particles = block(2, description=mpm.TotalLagrangian(), boundary=GRIP)

    def control(scene, particles, t, dt, memory):
        return eqx.tree_at(lambda s: s.gravity, scene, (memory, -memory)), particles, memory + 1.0

    q = jax.tree.map(lambda a: a.astype(dtype), particles)
    run = mpm.simulate(scene, q, t1=4 * DT, dt=DT, control=control, memory=0.0)
    step = mpm.prepare(scene, q)
    for n in range(4):
        here = eqx.tree_at(lambda s: s.gravity, scene, (float(n), -float(n)))
        step = mpm.step(here, step, n * DT, DT)[0]
    assert run.final.x.dtype == dtype
    assert_close(run.final.v, step.v, 100 * float(jnp.finfo(dtype).eps))
    assert float(run.final_memory) == 4


@pytest.mark.parametrize("forward", [False, *thorough(True)])
@pytest.mark.parametrize("method", [mpm.Explicit(), *thorough(mpm.SemiImplicit())])
def test_the_gradient_by_a_policy_is_that_of_differences(method, forward):
    def reached(gain):
        scene, particles, of = walker(gain)
        of |= {"adjoint": diffrax.ForwardMode()} if forward else {}
        run = mpm.simulate(scene, particles, t1=8 * DT, dt=DT, method=method, **of)
        return ((run.final.x[:, 0] ** 2).sum() + run.final_memory["mean"],) * 2

    both, h = jax.jit((jax.jacfwd if forward else jax.grad)(reached, has_aux=True)), 1e-5
    for k, slope in enumerate(both(GAIN)[0]):
        e = h * jnp.eye(3)[k]
        assert float(slope) == pytest.approx(float(both(GAIN + e)[1] - both(GAIN - e)[1]) / (2 * h), rel=2e-5)


def test_a_run_goes_on_from_its_memory_and_its_file(whole, tmp_path):
    """Bit for bit; the file knows the numbers of a policy, and refuses others."""
    scene, particles, of = walker()
    half = mpm.simulate(scene, particles, t1=4 * DT, dt=DT, save_every=4, **of)
    on = of | {"memory": half.final_memory}
    rest = mpm.simulate(scene, half.final, t1=12 * DT, dt=DT, start=4, save_every=4, **on)
    jax.tree.map(np.testing.assert_array_equal, rest.final, whole.final)
    path = tmp_path / "run.vtkhdf"
    mpm.record(path, scene, particles, t1=4 * DT, dt=DT, save_every=4, **of)
    other = of | {"control": Policy(2 * GAIN)}
    with pytest.raises(ValueError, match="holds another run: its control is 'Policy "):
        mpm.record(path, scene, particles, t1=12 * DT, dt=DT, save_every=4, resume=True, **other)
    for memory in (None, {"shift": np.zeros(2), "mean": 1.0}, {"shift": np.zeros((2, 1)), "mean": 0.0}):
        other = of | {"memory": memory}
        with pytest.raises(ValueError, match=r"holds another run: its control is 'Policy .* with memory"):
            mpm.record(path, scene, particles, t1=12 * DT, dt=DT, save_every=4, resume=True, **other)
    ended = mpm.record(path, scene, particles, t1=12 * DT, dt=DT, save_every=4, resume=True, **of)
    jax.tree.map(np.testing.assert_array_equal, ended.final, whole.final)
    jax.tree.map(np.testing.assert_array_equal, ended.final_memory, whole.final_memory)
    mpm.save(tmp_path / "saved.vtkhdf", whole)
    with pytest.raises(ValueError, match=r"control is 'unknown' .* go on by simulate"):
        mpm.record(tmp_path / "saved.vtkhdf", scene, particles, t1=12 * DT, dt=DT, save_every=4, resume=True, **of)
    for name in ("run", "saved"):
        run = mpm.load(tmp_path / f"{name}.vtkhdf")
        jax.tree.map(np.testing.assert_array_equal, run.frames, whole.frames)
        for a, b in zip(run.memory, jax.tree.leaves(whole.memory), strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_fault_is_named_with_the_scene_of_its_step():
    """A wall that the control alone moves is passed; the last good state has its memory."""
    scene, particles = block(2, boundary=mpm.StickyCollider(mpm.Box((-0.3, -0.3), (-0.1, 0.6)), mpm.geometry.still(2)))

    def control(scene, particles, t, dt, memory):
        late = jnp.where(t > 3.5 * DT, 0.35 / DT, 0.0)
        jump = jnp.where(jnp.abs(t - 3 * DT) < DT / 2, jnp.ones(2), 0.0)
        there = mpm.Motion(jnp.stack([3.9 * DT + 0 * t, 4.0 * DT + 0 * t]), jnp.stack([jnp.zeros(2), jump]))
        scene = eqx.tree_at(lambda s: s.boundary[0].motion, scene, there)
        return scene, replace(particles, v=particles.v - late * jnp.asarray([1.0, 0.0])), memory + 1.0

    with pytest.raises(mpm.SimulationError, match=r"At step 4 \(t = .*passed boundary 0") as error:
        mpm.simulate(scene, particles, t1=20 * DT, dt=DT, control=control, memory=0.0, save_every=1)
    run = error.value.run
    assert float(run.final_memory) == float(run.final_step) == len(run) - 1


def test_controls_that_break_their_promise_are_refused(tmp_path):
    scene, particles = block(2, material=MUSCLE)
    walled, _ = block(2, material=MUSCLE, boundary=GRIP)

    def contract(s, q, t, dt, m):
        return s, eqx.tree_at(lambda q: q.history.activation, q, 0.5), m

    for control, memory, told in (
        (lambda s, q, t, dt, m: (s, q), None, r"must return \(scene, particles, memory\)"),
        (lambda s, q, t, dt, m: q, None, r"must return \(scene, particles, memory\)"),
        (lambda s, q, t, dt, m: (s, q, (m, m)), 0.0, r"shapes that it was given: memory has shape None and had \(\)"),
        (lambda s, q, t, dt, m: (s, q, [m[0]]), (0.0,), "of the structure and shapes that it was given"),
        (contract, None, r"particles.histories.0.activation has shape \(\) and had \(36,\)"),
        (lambda s, q, t, dt, m: (walled, q, m), None, "the boundaries, loads, laws and grid that it was given"),
        (lambda s, q, t, dt, m: (s, q, m), True, "memory must be a pytree of floats"),
        (Outlet(mpm.Box((0.0,) * 3, (1.0,) * 3)), None, "region must have 2 coordinates, as the run, got 3"),
        (replace(jet(1.0)[1], first=5), None, "from number 5 on must be among the 36 of the run"),
    ):
        of = {"t1": DT, "dt": DT, "save_every": 1, "control": control, "memory": memory}
        with pytest.raises(ValueError, match=told):
            mpm.record(tmp_path / "run.h5", scene, particles, **of)
        assert not list(tmp_path.iterdir())
    scene, particles = block(2)
    total = mpm.Scene(scene.grid, scene.material, description=mpm.TotalLagrangian())
    moving = mpm.Scene(mpm.Grid(scene.grid.shape, scene.grid.spacing, follow=True), scene.material)
    for other, told in ((total, "in the updated description only: drop Tot"), (moving, "window rests: drop follow")):
        with pytest.raises(ValueError, match=told):
            mpm.simulate(other, particles, t1=DT, dt=DT, control=Outlet(mpm.Box((0.0, 0.0), (0.1, 0.1))))


@pytest.mark.thorough
def test_fibres_pull_along_their_direction():
    """T (F a0) a0ᵀ/λ, a convex energy, and a bound of its tangent."""
    contracted = MUSCLE.elastic(MUSCLE.initial_history(jnp.ones((2, 2, 1))))
    contracted = eqx.tree_at(lambda law: law.tension, contracted, 700.0)
    check_law(contracted, dim=2)
    F = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2, 50)) * 0.3) + jnp.eye(2)[..., None]
    F = F[..., np.asarray(mpm.linalg.determinant(F)) > 0.2]
    a = np.array([0.6, 0.8])
    f = np.einsum("ijp,j->ip", F, a)
    pull = np.asarray(contracted.stress(F) - contracted.law.stress(F))
    assert_close(pull, 700.0 * np.einsum("ip,j->ijp", f / np.linalg.norm(f, axis=0), a))
    tangent = mpm.linalg.matrix_of(contracted.stress_differential(F), F)
    largest = np.linalg.eigvalsh(np.moveaxis(np.asarray(tangent), -1, 0))[:, -1]
    assert (largest <= contracted.stiffness_eigenvalues(F, 2, total=True).max(axis=0) * (1 + 1e-9)).all()


def test_fibres_out_of_the_plane_are_as_in_space():
    """Where the third stretch is one: the energy's λ and stresses in the plane, also of fibres normal to it."""
    for elevation in (0.7, np.pi / 2):
        scene, particles = block(2, material=replace(MUSCLE, elevation=elevation))
        q = mpm.prepare(scene, particles)
        F = jnp.asarray([[1.1, 0.2], [-0.1, 0.9]])
        q = eqx.tree_at(lambda q: (q.history.activation, q.F), q, (q.mass**0, jnp.broadcast_to(F, q.F.shape)))
        (points,) = scene.material_points(q)
        tau = np.einsum("ijp,kjp->pik", points.stress(points.deformation), points.deformation)
        assert_close(mpm.stress(scene, q)[:, :2, :2], tau / np.linalg.det(F))
        law, whole = points.law.in_space(points.deformation)
        pull = [law.energy(a) - law.law.energy(a) for law, a in ((points.law, points.deformation), (law, whole))]
        assert_close(*pull)
        check_law(eqx.tree_at(lambda law: law.tension, points.law, 700.0), dim=2)


def with_absent(particles, every=3):
    """Particles with others among them that have no mass, and the rows of those that have."""
    count = particles.count
    order = np.sort(np.concatenate([np.arange(count), np.arange(0, count, every)]))
    real = np.concatenate([[True], np.diff(order) > 0])
    many = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[order]), particles)
    mass, volume = (jnp.where(real, a, 0) for a in (many.mass, many.volume))
    return replace(many, x=many.x + jnp.where(real, 0, 0.013)[:, None], mass=mass, volume=volume), real


GAS = mpm.Fluid(1e4, tension=True)
FACES = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), friction=0.3)
SCENES = {
    **{name: {"transfer": transfer} for name, transfer in TRANSFERS.items()},
    "linear": {"kernel": mpm.BSpline(1)},
    "spline": {"gradient": mpm.SplineGradient()},
    "semi-implicit": {"method": mpm.SemiImplicit(1.0, mpm.implicit.ConjugateResidual(rtol=1e-13))},
    "backward Euler": {"method": mpm.BackwardEuler()},
    "fluid": {"material": GAS, "boundary": mpm.SeparatingBox((0.0, 0.0), (0.6, 0.6))},
    "faces": {"boundary": FACES},
    "faces, semi-implicit": {
        "boundary": FACES,
        "method": mpm.SemiImplicit(1.0, mpm.implicit.ConjugateResidual(rtol=1e-13)),
    },
    "averaged": {"volume": mpm.AveragedVolume()},
    "plastic": {"material": mpm.VonMises(1e4, 0.3, 400.0)},
}


@pytest.mark.thorough
@pytest.mark.parametrize("options", **ids(SCENES, "faces"))
def test_particles_without_mass_change_nothing(options):
    """To rounding, in every transfer and kind of scene; nor the longest step, the energy and the momentum."""
    options = {"gravity": (0.3, -9.81)} | options
    method = options.pop("method", mpm.Explicit())
    scene, particles = block(2, **options)
    v = 0.2 * np.random.default_rng(1).normal(size=particles.x.shape)
    particles = replace(particles, v=jnp.asarray(v))
    many, real = with_absent(particles)
    few = mpm.simulate(scene, particles, t1=8 * DT, dt=DT, method=method)
    run = mpm.simulate(scene, many, t1=8 * DT, dt=DT, method=method, control=lambda s, q, t, dt, m: (s, q, m))
    for name in ("x", "v", "F"):
        assert_close(getattr(run.final, name)[real], getattr(few.final, name), 1e-9)
    assert (np.asarray(run.final.mass) > 0).tolist() == real.tolist()
    assert_close(mpm.energy(scene, run.final).total, mpm.energy(scene, few.final).total, 1e-9)
    if scene.kernel.order > 1:
        assert_close(mpm.stable_dt(scene, many), mpm.stable_dt(scene, particles), 1e-2)


def far_away(particles, count):
    """The particles, the first of which have no mass and are at one place far off the others."""
    rows, place = slice(count), np.full(particles.dim, 1.0) * float(jnp.ptp(particles.x)) * 1.5
    mass, volume = (a.at[rows].set(0) for a in (particles.mass, particles.volume))
    return replace(particles, x=particles.x.at[rows].set(place.astype(particles.x.dtype)), mass=mass, volume=volume)


@pytest.mark.thorough
def test_what_is_not_there_is_in_no_measure():
    """Nor in averages of volumes, and in the longest step it counts as its material."""
    grid, law = mpm.Grid((30, 30), 0.1, origin=(-5, -5)), LAWS["neo_hookean"]
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.6, 0.4)), grid, density=100.0)
    scene, some = mpm.Scene(grid, law, volume=mpm.AveragedVolume()), far_away(block, 12)
    assert mpm.analysis.pieces(scene, some) == mpm.analysis.pieces(scene, block) == 1
    assert mpm.fitting.Extent(0)(scene, some) == 0.575
    assert mpm.fitting.Extent(1, "lower")(scene, replace(some, x=-some.x)) == -0.375
    assert_close(mpm.analysis.density(scene, some), np.where(np.asarray(some.mass) > 0, 100.0, 0.0))
    slope = jax.grad(lambda m: mpm.analysis.density(scene, replace(some, mass=m)).sum())(some.mass)
    assert np.isfinite(slope).all()
    drain = Outlet(mpm.Box((0.3, -1.0), (2.0, 1.0)), rest=(1.2, 1.2))
    run = mpm.simulate(scene, block, t1=4 * DT, dt=DT, control=drain)
    assert_close(run.final.F, np.broadcast_to(np.eye(2), run.final.F.shape))
    assert_close(mpm.energy(scene, run.final).total, 0.0, 0, 1e-12)
    heavy = mpm.fill(mpm.Box((0.8, 0.0), (1.2, 0.4)), grid, density=8e3)
    both = mpm.Scene(grid, (law, law))
    whole, part = (mpm.stable_dt(both, mpm.join(q, heavy)) for q in (block, some))
    assert_close(part, whole, 1e-6)
    waiting = mpm.join(far_away(block, block.count), heavy)
    mpm.stable_dt(both, waiting)  # nor does a warning call it thin
    mpm.attach(mpm.Scene(grid, (law, law), loads=mpm.PointLoad(mpm.PointsAt(((0.91, 0.1),)), (1.0, 0.0))), waiting)


def test_dust_of_the_smallest_particles_is_not_rounded_to_nothing():
    """Of a tenth of a picogram in single precision."""
    grid = mpm.Grid((14, 14, 14), 1e-6, origin=(-3, -3, -3))
    cube = mpm.fill(mpm.Box((0.0,) * 3, (3e-6,) * 3), grid, density=1e3, dtype=jnp.float32)
    scene = mpm.Scene(grid, LAWS["neo_hookean"])
    assert mpm.stable_dt(scene, far_away(cube, 40)) == pytest.approx(float(mpm.stable_dt(scene, cube)), rel=1e-5)


def test_a_picture_of_nothing_has_no_colours(tmp_path):
    scene, particles = block(2)
    drain = Outlet(mpm.Box((-1.0, -1.0), (2.0, 2.0)), rest=(0.0, 0.0))
    run = mpm.simulate(scene, particles, t1=DT, dt=DT, control=drain, save_every=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mpm.render(run, tmp_path / "none.png", colour="speed")


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_pictures_show_where_particles_with_mass_are(d, tmp_path):
    scene, particles = block(d, side=9)
    particles = jax.tree.map(lambda a: a[(particles.x < 0.3).all(axis=1)], particles)
    drain = Outlet(mpm.HalfSpace((0.1,) * d, (1.0,) + (0.0,) * (d - 1)), rest=(0.9,) * d)
    run = mpm.simulate(scene, particles, t1=2 * DT, dt=DT, control=drain, save_every=1)
    canvas = _flat_canvas if d == 2 else partial(_solid_canvas, view=(30.0, 20.0))
    assert canvas(run, None, "")[0].axes[0].get_xlim()[1] < 0.5
    plt.close()
    mpm.render(run, tmp_path / "run.png", colour="speed")


def jet(speed, length=0.3):
    grid = mpm.Grid((20, 14), 0.1, origin=(-5, -3))
    stock = mpm.fill(mpm.Box((-0.9, 0.4), (0.0, 0.6)), grid, density=1e3)
    inlet = Inlet(stock, (speed, 0.0), gate=mpm.HalfSpace((0.0, 0.5), (2.0, 0.0)), length=length)
    return mpm.Scene(grid, mpm.Fluid(1e4), gravity=(0.0, -1.0)), inlet


def test_a_nozzle_lets_in_mass_as_fast_as_it_flows():
    """ρ v A t besides what fills the nozzle, and the run's table says it; what waits is in no sum and rests."""
    scene, inlet = jet(1.0)
    run = mpm.simulate(scene, inlet.particles(), t1=0.4, dt=2e-3, control=inlet, save_every=50)
    mass = np.asarray(run.frames.mass).sum(axis=1)
    assert_close(mass, [60.0, 80.0, 100.0, 120.0, 140.0])
    assert_close(mass, [inlet.entered(t) for t in run.times])
    assert_close(mpm.table(run)["mass [kg]"], mass)
    waiting = np.asarray(run.final.mass) == 0
    assert_close(run.final.x[waiting, 0], np.full(waiting.sum(), -0.3), 0, 3e-3)
    out = np.asarray(run.final.x[:, 0]) > 0.05
    assert_close(run.final.v[out, 0].mean(), 1.0, 0.05)
    assert (np.asarray(run.final.v)[out, 1] < 0).all()


@pytest.mark.thorough
def test_the_gradient_by_the_speed_of_a_nozzle_is_that_of_differences():
    def reached(speed):
        scene, inlet = jet(speed)
        of = {"control": inlet, "checkpoint_bytes": 2**15}
        final = mpm.simulate(scene, inlet.particles(), t1=0.2, dt=2e-3, **of).final
        return (final.mass[:, None] * final.x**2).sum()

    both, speed, h = jax.jit(jax.value_and_grad(reached)), 1.013, 1e-6
    slope = (both(speed + h)[0] - both(speed - h)[0]) / (2 * h)
    assert float(both(speed)[1]) == pytest.approx(float(slope), rel=1e-6)
    assert abs(slope) > 1


def test_what_an_outlet_takes_is_gone_and_what_is_dug_leaves_a_hole(tmp_path):
    """With a nozzle that still feeds, in a file that goes on."""
    scene, inlet = jet(1.0)
    start = mpm.join(inlet.particles(), mpm.fill(mpm.Box((0.9, 0.0), (1.1, 0.2)), scene.grid, density=1e3), material=0)
    drain = mpm.HalfSpace((0.25, 0.5), (-1.0, 0.0))
    control = Controls((inlet, Outlet(drain, start=0.1), Outlet(mpm.Box((0.8, -0.1), (1.2, 0.1)), start=0.05)))
    part, path = {"dt": 2e-3, "save_every": 50, "control": control}, tmp_path / "run.vtkhdf"
    mpm.record(path, scene, start, t1=0.2, **part)
    run = mpm.record(path, scene, start, t1=0.4, resume=True, **part)
    run = mpm.load(path)
    there = np.asarray(run.frames.mass) > 0
    assert there[:, inlet.stock.count :].sum(axis=1).tolist() == [16, 8, 0, 0, 0]
    mass, entered = np.asarray(run.frames.mass).sum(axis=1), np.array([float(inlet.entered(t)) for t in run.times])
    assert mass[0] == entered[0] + 40
    assert (mass[2], mass[4] < entered[4] - 20) == (pytest.approx(entered[2]), True)
    assert (np.asarray(run.frames.x)[2:][there[2:]][:, 0] < 0.26).all()
    mpm.render(run, tmp_path / "run.png", colour="speed")
    fields = mpm.load(path, frame=0)
    assert_close(fields.final.mass, run.frames.mass[0])


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "left"), [("soft_walker", "soft_walker.gif"), ("throw", "throw.png")])
def test_the_examples_run(name, left, tmp_path):
    """In their small size, as fresh programs in single precision."""
    script = [sys.executable, str(Path(__file__).parents[1] / "examples" / f"{name}.py"), "--quick"]
    ran = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / left).exists()


def test_masses_and_volumes_are_zero_together():
    _, particles = block(2)
    with pytest.raises(ValueError, match="or both zero of one that is not there"):
        replace(particles, mass=particles.mass.at[0].set(0.0))


def test_bad_nozzles_are_refused():
    _, inlet = jet(1.0)
    with pytest.raises(ValueError, match="must not lead back"):
        replace(inlet, velocity=(-1.0, 0.0))
    with pytest.raises(ValueError, match="as many coordinates"):
        replace(inlet, velocity=(1.0,))
    with pytest.raises(ValueError, match="rest must have 2 coordinates"):
        Outlet(mpm.Box((0.0, 0.0), (np.inf, 1.0)), rest=(0.0,))
