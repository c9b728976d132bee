"""Pictures: what hides what, which way is up and out, where walls and obstacles are."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from helpers import LAWS, PLASTIC, thorough

import mpmjax as mpm
import mpmjax.viz._render
from mpmjax.simulation._run import no_steps
from mpmjax.state._particles import State
from mpmjax.viz._picture import gaps, outward, skin
from mpmjax.viz._render import (
    _bearing,
    _flat_canvas,
    _obstacles,
    _remembered,
    _tinted,
    _upright,
)


def still_run(x, *, volume=1e-3, v=None, **scene) -> mpm.Run:
    """A run of particles at x, (f, p, d), that was never simulated."""
    x = jnp.asarray(x, float)
    f, p, d = x.shape
    F, v = jnp.broadcast_to(jnp.eye(d), (f, p, d, d)), jnp.zeros_like(x) if v is None else v
    size = jnp.full(p, volume)
    final = mpm.Particles(x=x[-1], v=v[-1], mass=size, volume=size, deformations=(F[-1],), C=F[-1])
    whole = mpm.Scene(mpm.Grid((20,) * d, 0.1), LAWS["neo_hookean"], **scene)
    steps = jnp.arange(float(f))
    return mpm.Run(
        whole, mpm.Explicit(), 0.5, steps, State(x, v, F, (F,), (None,)), None, final, steps[-1], no_steps(x.dtype)
    )


def test_outward_normals_are_those_of_the_bodys_surface():
    """On a block's faces along their normals, nowhere in its middle; a particle alone has none."""
    a = (np.arange(16) + 0.5) / 16
    x = np.stack(np.meshgrid(a, a, a), axis=-1).reshape(-1, 3)
    normal = outward(x, np.full(len(x), 1 / 16**3))
    top = (x[:, 2] == a[-1]) & (np.abs(x[:, :2] - 0.5) < 0.2).all(axis=1)
    np.testing.assert_allclose(
        normal[top] / np.linalg.norm(normal[top], axis=1, keepdims=True), np.tile([0, 0, 1], (top.sum(), 1)), atol=0.02
    )
    assert np.linalg.norm(normal[top], axis=1).min() > 0.3
    assert np.abs(normal[(np.abs(x - 0.5) < 0.2).all(axis=1)]).max() < 0.05
    assert np.abs(outward(np.zeros((1, 3)), np.ones(1))).max() < 0.05


@pytest.mark.parametrize("turned", [False, True])
def test_the_nearer_of_two_hides_the_farther(tmp_path, turned):
    """Seen along the second axis; turned by half a circle, the other one is nearer."""
    x = np.array([[[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    v = jnp.asarray(x)  # the first at rest, dark blue, the second bright yellow
    path = tmp_path / "two.png"
    mpm.render(still_run(x, v=v, volume=0.03, gravity=(0.0, 0.0, -9.8)), path, dpi=30.0, view=(180.0 * turned, 1.0))
    yellow, blue = coloured(path)
    assert (yellow.sum() > 10 * blue.sum()) == turned
    assert (blue.sum() > 10 * yellow.sum()) != turned


def coloured(path):
    """Where a picture, without its colour bar, is bright yellow and where dark blue."""
    image = matplotlib.image.imread(path)[:, :200, :3]
    yellow = (image[..., 0] > 0.6) & (image[..., 2] < 0.4)
    return yellow, (image[..., 2] > 1.4 * image[..., 1]) & (image[..., 0] < 0.4)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.8), (0.1, -9.8, 0.0), (-9.8, 0.0, 0.0), (0.0, 0.0, 9.8), None])
def test_up_is_against_gravity(gravity):
    """The frame is right-handed, and its third axis is up."""
    turn = _upright(mpm.Scene(mpm.Grid((5,) * 3, 1.0), LAWS["neo_hookean"], gravity=gravity))
    expected = {1: (0, 1, 0), 0: (1, 0, 0)}.get(0 if gravity is None else int(np.abs(gravity).argmax()), (0, 0, 1))
    sign = -1 if gravity == (0.0, 0.0, 9.8) else 1
    if gravity is None:
        expected = (0, 0, 1)
    np.testing.assert_array_equal(turn[2], sign * np.array(expected))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1)


@pytest.mark.parametrize("axis", [1, 2])
def test_the_upper_particle_is_drawn_above(tmp_path, axis):
    """Of two particles, one above the other, the fast one is bright yellow and the slow one dark blue."""
    x = np.zeros((1, 2, 3))
    x[0, 1, axis] = 1.0
    v = jnp.asarray(x)
    gravity = [0.0] * 3
    gravity[axis] = -9.8
    path = tmp_path / "up.png"
    mpm.render(still_run(x, v=v, volume=0.03, gravity=gravity), path, dpi=30.0)
    yellow, blue = coloured(path)
    assert min(yellow.sum(), blue.sum()) > 100
    assert np.nonzero(yellow)[0].max() < np.nonzero(blue)[0].min()


def test_walls_are_where_the_boundary_has_them():
    inf = float("inf")
    box = mpm.SlipBox((0.1, -inf), (inf, 1.5))
    planes = (mpm.ContactPlane(1, 0.2), mpm.SymmetryPlane(0, 1.0, "below"))
    scene = mpm.Scene(mpm.Grid((20, 20), 0.1), LAWS["neo_hookean"], boundary=(box, *planes))
    walls = [wall for boundary in scene.boundary for wall in boundary.walls()]
    assert [wall[:3] for wall in walls] == [(0, 0.1, 1), (1, 1.5, -1), (1, 0.2, 1), (0, 1.0, -1)]
    assert [wall.mirrored for wall in walls] == [False, False, True, True]


def test_the_ground_is_the_highest_wall_that_bears():
    box = mpm.SlipBox((0.1, 0.2, float("-inf")), (1.1, 1.2, 1.3))
    planes = (mpm.ContactPlane(1, 0.3), mpm.SymmetryPlane(1, 1.0, "below"))
    scene = mpm.Scene(mpm.Grid((20,) * 3, 0.1), LAWS["neo_hookean"], boundary=(box, *planes))
    assert _bearing(scene, np.array([0.0, 1.0, 0.0])) == 0.3
    assert _bearing(scene, np.array([0.0, -1.0, 0.0])) == -1.0
    assert _bearing(scene, np.array([1.0, 0.0, 0.0])) == 0.1
    assert _bearing(scene, np.array([0.0, 0.0, 1.0])) is None


def test_the_skin_of_a_shape_lies_on_it():
    """Its points have no distance, its normals are the distance's gradient, and no part of the surface lacks points."""
    ball = mpm.Ball((0.1, 0.2, 0.3), 0.5)
    x, normal = skin(lambda p: np.asarray(ball.distance(jnp.asarray(p))), np.full(3, -1.0), np.full(3, 1.0), 0.07)
    centre = np.array(ball.centre)
    np.testing.assert_allclose(np.linalg.norm(x - centre, axis=1), 0.5, atol=1e-6)
    np.testing.assert_allclose(normal, (x - centre) / 0.5, atol=1e-4)
    direction = np.random.default_rng(0).normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.linalg.norm(centre + 0.5 * direction[:, None] - x, axis=2).min(axis=1).max() < 0.07


def obstacle(shape, motion, t):
    """The distance to the one obstacle of a scene at time t."""
    body = mpm.SeparatingCollider(shape, motion)
    (distance,) = _obstacles(mpm.Scene(mpm.Grid((5,) * shape.dim, 1.0), LAWS["neo_hookean"], boundary=body), t)
    return distance


@pytest.mark.parametrize(("t", "at"), [(0.0, 0.0), (0.5, 1.0)])
def test_obstacles_move(t, at):
    """Their distance is that of where they are at the time."""
    motion = mpm.Motion((0.0, 1.0), ((0.0,) * 3, (2.0, 0.0, 0.0)))
    distance = obstacle(mpm.Ball((0.0,) * 3, 0.5), motion, t)
    np.testing.assert_allclose(distance(np.array([[at, 0, 0.5], [at, 0, 0]])), [0, -0.5], atol=1e-12)


@pytest.mark.thorough
def test_obstacles_turn():
    """A bar along the first axis that is turned by a right angle about its end, and moved: in the plane and in space,
    where a turn about the second axis takes the first into minus the third."""
    times, quarter = (0.0, 1.0), np.pi / 2
    bar = mpm.Box((1.0, 1.9), (3.0, 2.1))
    flat = mpm.RigidMotion(times, ((0.0, 0.0), (10.0, 0.0)), (0.0, quarter), (1.0, 2.0))
    x = np.array([[11.0, 3.0], [11.1, 2.5], [11.0, 4.5], [13.0, 2.0]])
    np.testing.assert_allclose(obstacle(bar, flat, 1.0)(x), [-0.1, 0.0, 0.5, 1.9], atol=1e-12)
    rod = mpm.geometry.Cylinder((1.0, 2.0, 3.0), (3.0, 2.0, 3.0), 0.1)
    solid = mpm.RigidMotion(times, ((0.0,) * 3, (10.0, 0.0, 0.0)), ((0.0,) * 3, (0.0, quarter, 0.0)), (1.0, 2.0, 3.0))
    x = np.array([[11.0, 2.0, 2.0], [11.0, 2.1, 2.5], [11.0, 2.0, 0.5], [13.0, 2.0, 3.0]])
    np.testing.assert_allclose(obstacle(rod, solid, 1.0)(x), [-0.1, 0.0, 0.5, 1.9], atol=1e-12)
    np.testing.assert_allclose(obstacle(rod, solid, 0.0)(x[3:] - [10.0, 0.0, 0.0]), [0.0], atol=1e-12)


@pytest.mark.parametrize("d", [*thorough(2), 3])
def test_obstacles_are_drawn(tmp_path, d):
    """There are more pixels of stone with one than without."""
    a = np.linspace(0, 1, 6)
    x = np.stack(np.meshgrid(*[a] * d), axis=-1).reshape(1, -1, d)
    counts = []
    for boundary in ((), mpm.SlipCollider(mpm.Ball((0.5,) * (d - 1) + (-0.3,), 0.25))):
        mpm.render(still_run(x, volume=0.2**d, boundary=boundary), tmp_path / "a.png", colour=None, dpi=30.0)
        image = matplotlib.image.imread(tmp_path / "a.png")
        counts.append(((image[..., 0] < 0.7) & (image[..., 0] > 1.03 * image[..., 2])).sum())
    assert counts[0] < 20
    assert counts[1] > counts[0] + 100


@pytest.mark.parametrize("stretch", [1.0, 1.5])
def test_squares_are_as_large_as_their_particles(stretch):
    """In two dimensions the squares' area is the deformed particles', measured in pixels."""
    x = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(1, -1, 2)
    figure, draw = _flat_canvas(still_run(x, volume=0.3), None, "")
    final = still_run(x, volume=0.3).final
    F = final.deformations[0].at[:, 0].multiply(stretch)
    draw(dataclasses.replace(final, deformations=(F,)), np.full(x.shape[1], np.nan), 0.0)
    figure.set_dpi(100)
    figure.canvas.draw()
    axes = figure.axes[0]
    scale = np.diff(axes.transData.transform([[0, 0], [1, 0]]), axis=0)[0, 0]
    box = np.round(axes.get_window_extent().extents).astype(int)
    image = np.asarray(figure.canvas.buffer_rgba())[::-1][box[1] + 3 : box[3] - 3, box[0] + 3 : box[2] - 3, 0]
    covered = ((255.0 - image) / (255 - image.min())).sum()
    assert covered == pytest.approx(12 * 0.3 * stretch * scale**2, rel=0.02)


def test_squares_turn_and_shear_with_their_particles():
    """A corner is where F takes it, as that of a parallelogram."""
    run = still_run(np.ones((1, 1, 2)), volume=0.36)
    figure, draw = _flat_canvas(run, None, "")
    c, s = np.cos(0.5), np.sin(0.5)
    F = np.array([[c, -s], [s, c]]) @ [[1.0, 0.4], [0.0, 1.0]]
    draw(dataclasses.replace(run.final, deformations=(jnp.asarray(F)[None],)), np.full(1, np.nan), 0.0)
    (path,) = figure.axes[0].collections[0].get_paths()
    corners = 1 + 0.3 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ F.T
    np.testing.assert_allclose(path.vertices[:4], corners, atol=1e-6)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("colour", ["speed", "none"])
def test_one_particle_is_drawn(tmp_path, d, colour):
    path = tmp_path / "one.png"
    mpm.render(still_run(np.zeros((1, 1, d))), path, colour=colour, dpi=30.0)
    image = matplotlib.image.imread(path)[..., :3]
    assert np.ptp(image) > 0.2


def test_a_movie_has_all_frames_of_one_size(tmp_path):
    """And the camera stands still: what does not move stays where it is."""
    from PIL import Image

    x = np.zeros((3, 2, 3))
    x[:, 1, 0] = [1.0, 1.5, 2.0]
    mpm.render(still_run(x, volume=0.03), tmp_path / "a.gif", colour=None, dpi=30.0)
    with Image.open(tmp_path / "a.gif") as movie:
        assert movie.n_frames == 3
        frames = []
        for i in range(3):
            movie.seek(i)
            frames.append(np.asarray(movie.convert("L"), float))
    left = [frame[20:-20, 30:80] for frame in frames]
    assert np.abs(left[0] - left[2]).max() < 30 < np.abs(frames[0] - frames[2]).max()


@pytest.mark.parametrize("law", ["drucker_prager", *thorough("neo_hookean")])
def test_neighbours_of_a_stretched_body_leave_no_gap(tmp_path, law):
    """A body whose particles have moved apart is filled, whether F says that they have or a law that yields forgot."""
    a = np.arange(8.0)
    x = np.stack(np.meshgrid(3 * a, a), axis=-1).reshape(1, -1, 2)
    run = still_run(x, volume=1.0)
    if law == "neo_hookean":
        F = run.frames.deformations[0].at[..., 0, 0].set(3)
        run = dataclasses.replace(run, frames=dataclasses.replace(run.frames, deformations=(F,)))
    run = dataclasses.replace(run, scene=dataclasses.replace(run.scene, material=(LAWS | PLASTIC)[law]))
    mpm.render(run, tmp_path / "a.png", colour="none", dpi=60.0)
    image = matplotlib.image.imread(tmp_path / "a.png")
    blue = image[..., 2] > image[..., 0] + 0.1
    rows, columns = np.nonzero(blue)
    edge = 0 if law == "neo_hookean" else np.ptp(rows) // 8  # on a flow's, half of a particle stands out of the filling
    assert blue[rows.min() + edge : rows.max() - edge, columns.min() : columns.max()].all()


def test_gaps_of_a_flow_are_filled():
    """Columns of a flow that are three widths apart close, and those five apart do not; nor a few particles."""
    x = np.stack(np.meshgrid([0.0, 3, 6, 11, 14], np.arange(4.0)), axis=-1).reshape(-1, 2)
    flows = np.ones(len(x), bool)
    corners = x[gaps(x, flows, 4.0)]
    a, b = np.moveaxis(corners[:, 1:3] - corners[:, :1], 1, 0)
    assert np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2 == pytest.approx(9 * 3)
    assert ((corners[..., 0] > 6).all(axis=1) | (corners[..., 0] < 11).all(axis=1)).all()
    assert len(gaps(x, ~flows, 4.0)) == len(gaps(x[:3], flows[:3], 4.0)) == 0


def test_colours_leave_out_what_is_rare_and_say_so():
    """Of 200 particles one is a thousand times as fast; the bar is as high as the plot."""
    x = np.stack(np.meshgrid(np.arange(20.0), np.arange(10.0)), axis=-1).reshape(1, -1, 2)
    v = np.full_like(x, 1.0)
    v[0, :100, 0], v[0, 0, 0] = 0.5, 1e3
    figures = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mpmjax.viz._render, "save_figure", lambda figure, *_: figures.append(figure))
        mpm.render(still_run(x, v=jnp.asarray(v)), "never.png")
    (figure,), (axes,) = figures, figures[0].axes
    figure.canvas.draw()
    (bar,) = axes.child_axes
    assert bar.get_ylabel() == "speed [m/s], 1st to 99th percentile"
    assert bar.get_ylim()[1] < 2
    plot, beside = axes.get_window_extent(), bar.get_window_extent()
    np.testing.assert_allclose([beside.y0, beside.y1], [plot.y0, plot.y1], atol=1)


def test_a_film_is_mp4_where_ffmpeg_is(tmp_path, monkeypatch):
    """It gets each frame's pixels, and what it has against them is said; without it a .gif is proposed."""
    x = np.zeros((3, 2, 2))
    x[:, 1, 0] = [1.0, 1.5, 2.0]
    run, path = still_run(x, volume=0.03), tmp_path / "a.mp4"
    (tmp_path / "ffmpeg").write_text('#!/bin/sh\nfor name; do true; done\ncat > "$name"\n')
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    mpm.render(run, path, dpi=30.0)
    first, second, third = np.split(np.frombuffer(path.read_bytes(), np.uint8), 3)
    assert not np.array_equal(first, second)
    assert not np.array_equal(second, third)
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\necho no room >&2\nexit 1\n")
    with pytest.raises(OSError, match=r"a\.mp4 could not be written: ffmpeg: no room\. It is as it was"):
        mpm.render(run, path, dpi=30.0)
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match="needs the program ffmpeg"):
        mpm.render(run, path)


def test_colours_by_what_a_law_remembers_and_by_material():
    """Values where a law remembers them, the material's own colour elsewhere."""
    from matplotlib import cm, colors

    grid = mpm.Grid((20, 20), 0.1)
    parts = [mpm.fill(mpm.Box((a, 0.5), (a + 0.2, 0.7)), grid, particles_per_cell=4, density=1.0) for a in (0.4, 0.9)]
    particles = mpm.prepare(mpm.Scene(grid, (LAWS["neo_hookean"], mpm.Snow())), mpm.join(*parts))
    bar = cm.ScalarMappable(colors.Normalize(0.0, 2.0), "viridis")
    values = _remembered("plastic_volume", None, particles)
    assert np.isnan(values[:16]).all()
    assert (values[16:] == 1).all()
    plain, tinted = _tinted(particles, None, values), _tinted(particles, bar, values)
    assert len(np.unique(plain[:16], axis=0)) == len(np.unique(plain[16:], axis=0)) == 1
    assert not np.array_equal(plain[0], plain[16])
    assert np.array_equal(tinted[:16], plain[:16])
    np.testing.assert_allclose(tinted[16], bar.to_rgba(1.0)[:3])


def test_materials_are_named_where_they_are_told_apart(monkeypatch):
    """By colours of their own, not by a bar of numbers between 1 and 2."""
    figures, law = [], LAWS["neo_hookean"]
    monkeypatch.setattr(mpmjax.viz._render, "save_figure", lambda figure, *_: figures.append(figure))
    run = still_run(np.zeros((1, 2, 2)))
    scene = mpm.Scene(run.scene.grid, {"rubber": law, "gel": law})
    F = run.frames.deformations[0]
    frames = dataclasses.replace(run.frames, deformations=(F[:, :1], F[:, 1:]), histories=(None, None))
    halves = {"counts": (1, 1), "deformations": (F[0, :1], F[0, 1:]), "histories": (None, None)}
    final = dataclasses.replace(run.final, **halves)
    mpm.render(dataclasses.replace(run, scene=scene, frames=frames, final=final), "never.png", colour="material")
    (axes,) = figures[0].axes
    assert not axes.child_axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(scene.titles)


def test_what_cannot_be_drawn_is_refused(tmp_path):
    run = still_run(np.zeros((1, 1, 3)))
    path = tmp_path / "a.png"
    for bad, says in (
        ({"colour": "heat"}, "colour must be one of speed"),
        ({"frame": 1}, "1 frames"),
        ({"view": (0.0, -5.0)}, "elevation"),
        ({"view": (0.0, 95.0)}, "elevation"),
    ):
        with pytest.raises(ValueError, match=says):
            mpm.render(run, path, **bad)
    with pytest.raises(ValueError, match="must end in"):
        mpm.render(run, tmp_path / "a.xyz")
    with pytest.raises(ValueError, match="frame is for a still"):
        mpm.render(run, tmp_path / "a.gif", frame=0)
    with pytest.raises(ValueError, match="no frames"):
        mpm.render(eqx.tree_at(lambda r: r.frames, run, None), path)
    assert not path.exists()


def test_notebooks_show_a_runs_last_frame_and_what_a_scene_contains():
    run = still_run(np.zeros((2, 1, 2)), volume=0.3, gravity=(0.0, -9.8))
    assert run._repr_html_().startswith('<img src="data:image/png;base64,iVBOR')
    assert "1 of 0.5 s, 2 frames" in run._repr_html_()
    alone = dataclasses.replace(run, frames=None)
    assert "<img" not in alone._repr_html_()
    failed = eqx.tree_at(lambda r: r.statistics.fault, alone, jnp.asarray(2))
    assert "OUTSIDE" in failed._repr_html_()
    several = eqx.tree_at(lambda r: r.final_step, run, jnp.zeros(3))
    assert "(3,)" in several._repr_html_()
    shown = run.scene._repr_html_()
    assert "youngs_modulus=" in shown
    assert "-9.8" in shown
    assert "loads" not in shown
