"""Pictures: where a ball appears and how large, what hides what, where light and shadow fall, which way is up."""

import equinox as eqx
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from helpers import LAWS, thorough

import mpmjax as mpm
from mpmjax.simulation._statistics import no_steps
from mpmjax.state._particles import State
from mpmjax.viz._ray_casting import SAMPLES, Balls, Camera, look, paint, picture, surroundings
from mpmjax.viz._render import (
    _bearing,
    _flat_canvas,
    _measure,
    _obstacles,
    _remembered,
    _round_length,
    _tinted,
    _upright,
    _walls,
    skin,
)

SIZE = (161, 121)


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


def level(width=SIZE[0], height=SIZE[1], focal=200.0) -> Camera:
    """A camera in the origin that looks along the second axis, the first to the right, the third up."""
    axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    return Camera(np.zeros(3), axes, focal, width, height, np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("centre", [(0.0, 3.0, 0.0), (0.7, 3.0, -0.5), (-1.0, 4.0, 0.9)])
def test_a_balls_silhouette_is_that_of_exact_perspective(centre):
    """A pixel shows the ball if and only if its ray passes within the angle asin(r / |c|) of its middle."""
    camera, c, r = level(), np.array(centre), 0.4
    _, owner = paint(camera, c[None], np.array([r]))
    column, row = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    ray = np.stack([(column - SIZE[0] / 2) / 200, np.ones_like(row), (SIZE[1] / 2 - row) / 200], axis=-1)
    angle = np.arctan2(np.linalg.norm(np.cross(ray, c), axis=-1), ray @ c)
    expected = angle < np.arcsin(r / np.linalg.norm(c))
    assert 500 < expected.sum() < 0.5 * expected.size
    np.testing.assert_array_equal(owner.reshape(SIZE[::-1]) == 0, expected)


def test_a_ball_straight_ahead_has_the_radius_of_the_tangent_cone():
    """f r / √(Z² − r²) pixels about the middle; its nearest point lies at Z − r."""
    depth, owner = paint(level(), np.array([[0.0, 3.0, 0.0]]), np.array([0.5]))
    radius = 200 * 0.5 / np.sqrt(9 - 0.25)
    assert abs((owner == 0).sum() - np.pi * radius**2) < 2 * radius
    assert depth.reshape(SIZE[::-1])[60, 80] == pytest.approx(2.5, rel=1e-6)


def test_nearer_balls_hide_farther_ones():
    """Whatever their order; also where two cut each other."""
    x, r = np.array([[0.0, 4.0, 0.0], [0.1, 3.0, 0.0], [0.0, 3.5, 0.3]]), np.array([0.6, 0.3, 0.4])
    depth, owner = paint(level(), x, r)
    alone = np.stack([paint(level(), x[i : i + 1], r[i : i + 1])[0] for i in range(3)])
    np.testing.assert_array_equal(depth, alone.min(axis=0))
    np.testing.assert_array_equal(owner, np.where(np.isinf(depth), -1, alone.argmin(axis=0)))
    assert {0, 1, 2} <= set(owner)
    order = np.array([2, 0, 1])
    shuffled = paint(level(), x[order], r[order])[1]
    np.testing.assert_array_equal(np.where(shuffled < 0, -1, order[shuffled]), owner)


def test_painting_many_is_painting_each():
    """Windows of all sizes, in and across the picture's edge, and balls behind the eye or smaller than a pixel."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform((-3, -1, -2), (3, 8, 2), (300, 3)), [[0.0, 2.0, 0.0]]])
    r = np.concatenate([10 ** rng.uniform(-2.5, -0.3, 300), [1e-6]])
    depth, _ = paint(level(), x, r)
    each = [paint(level(), x[i : i + 1], r[i : i + 1])[0] for i in range(len(x))]
    np.testing.assert_array_equal(depth, np.min(each, axis=0))
    assert np.isfinite(each[-1]).sum() >= 1
    assert np.isfinite(depth).sum() > 1000


def test_no_ball_at_all():
    depth, owner = paint(level(), np.zeros((0, 3)), np.zeros(0))
    assert np.isinf(depth).all()
    assert (owner == -1).all()


@pytest.mark.parametrize("view", [(0.0, 10.0), (35.0, 20.0), (-120.0, 75.0)])
def test_the_camera_holds_all_and_has_it_in_the_middle(view):
    x = np.random.default_rng(0).uniform((-1, 0, 3), (2, 1, 4), (50, 3))
    camera = look(x, 0.1, view, SIZE)
    place, depth = camera.project(x)
    assert (depth > 0).all()
    lower, upper = place.min(axis=0) / SIZE, place.max(axis=0) / SIZE
    assert 0.6 < (upper - lower).max() < 0.8
    np.testing.assert_allclose((lower + upper) / 2, 0.5, atol=0.02)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    back = camera.eye - camera.target
    assert np.degrees(np.arcsin(back[2] / np.linalg.norm(back))) == pytest.approx(view[1])
    np.testing.assert_allclose(camera.project(camera.eye[None] + camera.rays()[:1])[0], [[0.5, 0.5]], atol=1e-3)


def drawn(x, radius, *, ground, reach=4, view=(0.0, 30.0), light=(-60.0, 40.0), size=SIZE):
    """A picture of white balls, its camera and its light."""
    x, radius = np.array(x, float), np.full(len(x), radius)
    camera = look(x, reach * radius[0], view, size)
    lamp = look(x, 2 * radius[0], light, (512, 512), angle=5.0)
    about, slope = surroundings(x, 4 / 3 * np.pi * radius**3, ground)
    balls = Balls(x, radius, np.full((len(x), 3), 0.8), 0 * slope)
    return picture(camera, lamp, balls, about=about, ground=ground, square=1e-6).mean(axis=-1), camera, lamp


def brightness(image, camera, points):
    """Of the pixels where points appear."""
    place = camera.project(np.atleast_2d(points))[0].astype(int)
    return image[place[:, 1], place[:, 0]]


def test_what_faces_the_light_is_brighter():
    """Along the ball's equator of the picture, brightness falls with the angle to the light."""
    image, camera, lamp = drawn([[0.0, 0.0, 0.0]], 1.0, ground=None)
    towards = -lamp.axes[2]
    seen = -camera.axes[2]
    across = np.cross(np.cross(seen, towards), seen)
    across /= np.linalg.norm(across)
    angles = np.radians([-60, -30, 0, 30])
    values = brightness(image, camera, [np.cos(a) * seen + np.sin(a) * across for a in angles])
    assert np.all(np.diff(values) > 0.03)


def test_the_shadow_falls_away_from_the_light():
    """On the ground along the light from each ball, and nowhere else; a ball in another's shadow is darker too."""
    ball, radius, ground = np.array([[0.0, 0.0, 1.5]]), 0.3, 0.0
    image, camera, lamp = drawn(ball, radius, ground=ground, reach=20, size=(321, 241))
    ray = ball[0] - lamp.eye
    spot = ball[0] + ray * (ground - ball[0, 2]) / ray[2]
    aside = spot + np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    inside = brightness(image, camera, spot + 0.6 * radius * np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]))
    outside = brightness(image, camera, aside)
    assert inside.max() < 0.8 * outside.min()
    assert np.linalg.norm(spot[:2] - ball[0, :2]) > 4 * radius  # so that this is not the dark below the ball
    towards = -lamp.axes[2]
    alone, camera, _ = drawn([[0.0, 0.0, 0.0], [9.0, 9.0, 9.0]], 0.5, ground=None)
    open_ = brightness(alone, camera, 0.49 * towards)
    shaded, camera, _ = drawn([[0.0, 0.0, 0.0], 2.5 * towards], 0.5, ground=None)
    assert brightness(shaded, camera, 0.49 * towards) < 0.85 * open_


def test_a_gap_near_a_body_sees_less_sky():
    """The filled fraction before the ground falls with the distance to a block that stands on it."""
    a = (np.arange(16) + 0.5) / 16
    x = np.stack(np.meshgrid(a, a, a), axis=-1).reshape(-1, 3)
    about, slope = surroundings(x, np.full(len(x), 1 / 16**3), 0.0)
    points = np.array([[0.5, -s, 0.0] for s in (0.05, 0.2, 1.5)], np.float32)
    sky = about.sky(points, np.tile(np.float32([0, 0, 1]), (3, 1)))
    assert np.all(np.diff(sky) > 0.02)
    assert sky[-1] > 0.95
    # The slope points outward: on the block's faces along their normals, nowhere in its middle.
    top = (x[:, 2] == a[-1]) & (np.abs(x[:, :2] - 0.5) < 0.2).all(axis=1)
    np.testing.assert_allclose(
        slope[top] / np.linalg.norm(slope[top], axis=1, keepdims=True), np.tile([0, 0, 1], (top.sum(), 1)), atol=0.02
    )
    assert np.linalg.norm(slope[top], axis=1).min() > 0.3
    assert np.abs(slope[(np.abs(x - 0.5) < 0.2).all(axis=1)]).max() < 0.05


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
    image = matplotlib.image.imread(path)[:, :200, :3]  # without the colour bar
    yellow = (image[..., 0] > 0.6) & (image[..., 2] < 0.4)
    blue = (image[..., 2] > 1.6 * image[..., 1]) & (image[..., 0] < 0.4)
    assert min(yellow.sum(), blue.sum()) > 100
    assert np.nonzero(yellow)[0].max() < np.nonzero(blue)[0].min()


def test_walls_are_where_the_boundary_has_them():
    inf = float("inf")
    box = mpm.SlipBox((0.1, -inf), (inf, 1.5))
    planes = (mpm.ContactPlane(1, 0.2), mpm.SymmetryPlane(0, 1.0, "below"))
    scene = mpm.Scene(mpm.Grid((20, 20), 0.1), LAWS["neo_hookean"], boundary=(box, *planes))
    assert [wall[:3] for wall in _walls(scene)] == [(0, 0.1, 1), (1, 1.5, -1), (1, 0.2, 1), (0, 1.0, -1)]
    assert [wall.mirrored for wall in _walls(scene)] == [False, False, True, True]


def test_the_ground_is_the_highest_wall_that_bears():
    box = mpm.SlipBox((0.1, 0.2, float("-inf")), (1.1, 1.2, 1.3))
    planes = (mpm.ContactPlane(1, 0.3), mpm.SymmetryPlane(1, 1.0, "below"))
    scene = mpm.Scene(mpm.Grid((20,) * 3, 0.1), LAWS["neo_hookean"], boundary=(box, *planes))
    assert _bearing(scene, np.array([0.0, 1.0, 0.0])) == 0.3
    assert _bearing(scene, np.array([0.0, -1.0, 0.0])) == -1.0
    assert _bearing(scene, np.array([1.0, 0.0, 0.0])) == 0.1
    assert _bearing(scene, np.array([0.0, 0.0, 1.0])) is None


def test_the_measure_is_a_side_of_the_grounds_squares():
    """Its ends, brought back to the ground along their rays, are neighbours on the lattice; both are in the picture."""
    camera, ground, square = look(np.zeros((1, 3)), 1.0, (30.0, 20.0), SIZE), -0.7, 0.5
    ends = _measure(camera, ground, square)
    assert ((ends > 0) & (ends < SIZE)).all()
    rays = (ends - np.array(SIZE) / 2) / camera.focal @ camera.axes[:2] + camera.axes[2]
    x = camera.eye + rays * ((ground - camera.eye[2]) / rays[:, 2:])
    assert np.linalg.norm(x[1] - x[0]) == pytest.approx(square, rel=1e-4)
    np.testing.assert_allclose(x[:, :2] / square, np.round(x[:, :2] / square), atol=1e-4)


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
    rod = mpm.Cylinder((1.0, 2.0, 3.0), (3.0, 2.0, 3.0), 0.1)
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


def test_disks_are_as_large_as_their_particles():
    """In two dimensions the disks' area is the particles', measured in pixels."""
    x = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(1, -1, 2)
    figure, draw = _flat_canvas(still_run(x, volume=0.3), None, "")
    draw(still_run(x, volume=0.3).final, np.full(x.shape[1], np.nan), 0.0)
    figure.set_dpi(100)
    figure.canvas.draw()
    axes = figure.axes[0]
    scale = np.diff(axes.transData.transform([[0, 0], [1, 0]]), axis=0)[0, 0]
    box = np.round(axes.get_window_extent().extents).astype(int)
    image = np.asarray(figure.canvas.buffer_rgba())[::-1][box[1] + 3 : box[3] - 3, box[0] + 3 : box[2] - 3, 0]
    covered = ((255.0 - image) / (255 - image.min())).sum()
    assert covered == pytest.approx(12 * 0.3 * scale**2, rel=0.02)


@pytest.mark.parametrize(("length", "expected"), [(0.1, 0.1), (0.19, 0.1), (7.3, 5.0), (0.02, 0.02), (499.0, 200.0)])
def test_scales_are_round(length, expected):
    assert _round_length(length) == pytest.approx(expected)


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


def test_pictures_have_the_cameras_size():
    image, camera, _ = drawn([[0.0, 0.0, 0.0]], 1.0, ground=None)
    assert image.shape == (camera.height, camera.width)
    assert SAMPLES >= 2
