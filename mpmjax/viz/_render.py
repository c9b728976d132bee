"""Pictures of runs: matplotlib in one and two dimensions, balls in the light of `_ray_casting` in three."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mpmjax.analysis import energy_density, volume_ratio
from mpmjax.boundary import Wall
from mpmjax.checks import canonical, checked, require, require_between, require_memory
from mpmjax.io import replacing, save_figure
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene, by_material, history_arrays
from mpmjax.viz._ray_casting import Balls, Camera, look, picture, surroundings

COLOURS: dict[str, tuple[str, Callable[[Run, Particles], Any]]] = {
    "speed": ("speed [m/s]", lambda run, q: np.linalg.norm(q.v, axis=1)),
    "volume": ("volume ratio J [-]", lambda run, q: volume_ratio(q)),
    "energy": ("elastic energy density [J/m³]", lambda run, q: energy_density(run.scene, q)),
}
"""The quantities that can colour particles: a label, and a value for each particle."""

SNOW, OCHRE, STEEL, MOSS = (0.91, 0.93, 0.96), (0.82, 0.55, 0.33), (0.36, 0.5, 0.66), (0.45, 0.62, 0.42)
STONE = (0.55, 0.54, 0.52)
"""The colour of walls and colliders."""

Draw = Callable[[Particles, np.ndarray, float], None]


@checked
def render(
    run: Run,
    path: str | Path,
    *,
    colour: str | None = "speed",
    frame: int | None = None,
    view: tuple[float, float] = (30.0, 20.0),
    fps: int = 20,
    dpi: float = 120.0,
) -> None:
    """Draw a run: one frame as a still (.png, .pdf, .svg) or all of them as an animation (.gif).

    In two dimensions particles are disks of their undeformed volume, walls are lines. In three they are balls half as
    large again, so that they close into a body, lit from the upper left; up is against gravity's largest component (the
    last axis without gravity), and the ground is the highest wall or plane that bears, else a little below the
    particles. All frames of a run have the same view and scale.

    Args:
        run: a run with frames.
        path: the picture to write; its suffix says of which kind.
        colour: "speed", "volume", "energy", or the name of what a law remembers, such as snow's "plastic_volume"; None
            or "none" to see the shape alone, each material in a colour of its own.
        frame: which frame a still shows; counts from the end if negative. Default: the last.
        view: in three dimensions, azimuth and elevation of the eye [degrees]. At azimuth 0 the first horizontal axis
            points to the right; the elevation is above 0 and at most 90.
        fps: frames a second of an animation, from 1 to 100.
        dpi: resolution [dots an inch], from 1 to 6000.

    Raises:
        ValueError: a run without frames or particles, an unknown suffix or colour, a frame that is not there, an
            elevation that is not above the ground.
    """
    path = Path(path)
    suffixes = (".png", ".pdf", ".svg", ".gif")
    require(path.suffix in suffixes, f"A picture's name must end in one of {', '.join(suffixes)}, got {path.name!r}.")
    colour = None if colour == "none" else colour
    require(len(run) > 0, "The run has no frames to draw: pass save_every to simulate.")
    known = COLOURS | {
        name: (name.replace("_", " "), partial(_remembered, name)) for name, *_ in history_arrays(run.final)
    }
    require(colour is None or colour in known, f"colour must be one of {', '.join(known)}, none, got {colour!r}.")
    require(run.final.count > 0, "The run has no particles to draw.")
    require(
        frame is None or -len(run) <= frame < len(run), f"The run has {len(run)} frames, there is no frame {frame}."
    )
    require(frame is None or path.suffix != ".gif", "frame is for a still; a .gif shows all frames.")
    require_between("fps", fps, 1, 100)  # a GIF counts hundredths of a second
    require_between("dpi", dpi, 1, 6000)  # matplotlib draws fewer than 2^16 pixels a side
    require_memory(f"A picture of {dpi:g} dots an inch", 4 * 8 * 6 * dpi**2, "take a smaller dpi.")
    require_between("view's azimuth [degrees]", view[0], -360, 360)
    require_between("view's elevation [degrees]", view[1], 0.1, 90)
    still = path.suffix != ".gif"
    shown = [len(run) - 1 if frame is None else frame % len(run)] if still else range(len(run))
    label, value = ("", lambda run, q: np.full(q.count, np.nan)) if colour is None else known[colour]
    values = np.stack([np.asarray(value(run, run.frame(i))) for i in shown])
    from matplotlib import (  # here, since it takes a second that only pictures should pay
        animation,
        cm,
        colors,
        pyplot as plt,
    )

    bar = None
    if colour is not None:
        bar = cm.ScalarMappable(colors.Normalize(np.nanmin(values), np.nanmax(values)), "viridis")
    figure, draw = _solid_canvas(run, bar, label, view, dpi) if run.final.dim == 3 else _flat_canvas(run, bar, label)

    def show(k: int) -> None:
        draw(run.frame(shown[k]), values[k], float(run.times[shown[k]]))

    try:
        if still:
            show(0)
            save_figure(figure, path, dpi)
        else:
            movie = animation.FuncAnimation(figure, lambda k: show(k) or [], frames=len(values), init_func=lambda: [])
            with replacing(path) as aside:
                movie.save(aside, writer=animation.PillowWriter(fps=fps), dpi=dpi)
    finally:
        plt.close(figure)


def _remembered(name: str, run: Any, particles: Particles) -> np.ndarray:
    """The history variable of that name; NaN at particles whose law has none."""
    del run
    values = np.full(particles.count, np.nan)
    for known, rows, leaf in history_arrays(particles):
        if known == name:
            values[rows] = leaf
    return values


def _tinted(particles: Particles, bar: Any, values: np.ndarray) -> np.ndarray:
    """The particles' colours, (p, 3): by their values, and where there are none by their material."""
    palette = (SNOW, OCHRE, STEEL, MOSS) if particles.dim == 3 else (STEEL, OCHRE, MOSS, SNOW)
    colours = np.empty((particles.count, 3))
    for i, (rows, *_) in enumerate(by_material(particles)):
        colours[rows] = palette[i % len(palette)]
    if bar is None:
        return colours
    return np.where(np.isnan(values)[:, None], colours, bar.to_rgba(values)[:, :3])


def _walls(scene: Scene) -> Iterator[Wall]:
    """The walls and planes."""
    for boundary in scene.boundary:
        yield from boundary.walls()


def _obstacles(scene: Scene, t: float) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """The signed distance [m] of points [m], (m, d), to each body where it is at time t."""
    dtype = jnp.zeros(()).dtype
    nowhere = jnp.zeros((0, scene.grid.dim), dtype)
    for boundary in canonical(scene.boundary, dtype):
        if boundary.distance(nowhere, t) is not None:
            yield lambda x, body=boundary: np.asarray(body.distance(jnp.asarray(x, dtype), t))


def skin(
    distance: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a shape's surface and its outward normals there, each (n, d), about a spacing apart.

    Args:
        distance: signed distance to the shape [m] of points (m, d), negative inside.
        lower: lower corner of where to look [m], (d,).
        upper: upper corner [m], (d,).
        spacing: of the lattice whose points within a cell of the surface are moved onto it [m].
    """
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(lower, upper, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    x = x[np.abs(distance(x)) < 0.5 * len(axes) ** 0.5 * spacing]
    steps = 1e-2 * spacing * np.eye(len(axes))
    normal = np.stack([distance(x + e) - distance(x - e) for e in steps], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(np.finfo(float).tiny)
    return x - distance(x)[:, None] * normal, normal


def _upright(scene: Scene) -> np.ndarray:
    """To the right, away and up, one a row, (3, 3): up is against gravity's largest component."""
    gravity = np.asarray(scene.gravity, float)
    axis = int(np.abs(gravity).argmax()) if gravity.any() else 2
    up = np.eye(3)[axis] * (-1 if gravity[axis] > 0 else 1)
    right = np.eye(3)[0 if axis else 1]
    return np.stack([right, np.cross(up, right), up])


def _bearing(scene: Scene, up: np.ndarray) -> float | None:
    """The height [m] of the highest wall or plane that bears what lies on it; None without any."""
    axis = int(np.abs(up).argmax())
    heights = (
        float(up[axis]) * wall.position for wall in _walls(scene) if wall.axis == axis and wall.inward == up[axis]
    )
    return max(heights, default=None)


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that does not exceed a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(n for n in (1, 2, 5) if n * power <= 1.000001 * length))


def _solid_canvas(run: Run, bar: Any, label: str, view: tuple[float, float], dpi: float) -> tuple[Any, Draw]:
    """A figure of three dimensions, seen from where every frame is held, and what draws one."""
    from matplotlib import pyplot as plt

    assert run.frames is not None
    turn = _upright(run.scene)
    volume = np.asarray(run.final.volume, float)
    size = float(volume.mean()) ** (1 / 3)
    radius = 1.15 * (3 * volume / (4 * np.pi)) ** (1 / 3)
    everything = np.asarray(run.frames.x, float).reshape(-1, 3)
    lower, upper = everything.min(axis=0) - size, everything.max(axis=0) + size
    extent = float((upper - lower).max())
    square = _round_length(extent / 5)
    middle = np.round((lower + upper) / 2 / square) * square  # about which single precision does
    room, spacing = (lower - extent / 2, upper + extent / 2), max(size, extent / 50)

    def place(x: Any) -> np.ndarray:
        return (np.asarray(x, float) - middle) @ turn.T

    def stones(t: float) -> tuple[np.ndarray, np.ndarray]:
        """The obstacles' skins, below the surface by their balls' radius, and their normals."""
        skins = [skin(distance, *room, spacing) for distance in _obstacles(run.scene, t)]
        found = [(place(x - 1.5 * spacing * n), n @ turn.T) for x, n in skins]
        x, n = zip((np.zeros((0, 3)), np.zeros((0, 3))), *found, strict=True)
        return np.concatenate(x), np.concatenate(n)

    # The cells where particles ever are stand for them: what the cameras hold need be known no better.
    cells = np.unique(np.ravel_multi_index(tuple(((everything - lower) * (64 / extent)).astype(int).T), (65,) * 3))
    cloud = place(lower + (np.stack(np.unravel_index(cells, (65,) * 3), axis=-1) + 0.5) * (extent / 64))
    held = np.concatenate([cloud, stones(float(run.times[0]))[0]])
    bearing = _bearing(run.scene, turn[2])
    ground = float(held[:, 2].min() - 1.5 * spacing if bearing is None else bearing - turn[2] @ middle)
    figure = plt.figure(figsize=(8, 6))
    pixels = round(8 * dpi), round(6 * dpi)
    camera = look(held, radius.max() + extent / 64, view, pixels)
    light = look(held, radius.max() + extent / 32, (view[0] - 50.0, 50.0), (1024, 1024), angle=5.0, filled=0.98)
    axes: Any = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    image = axes.imshow(np.zeros((2, 2, 3)), extent=(0, pixels[0], pixels[1], 0), aspect="auto")
    time = figure.text(0.04, 0.93, "", size=15, color="0.2")
    if bar is not None:
        scale = figure.colorbar(bar, cax=figure.add_axes((0.87, 0.28, 0.018, 0.44)))
        scale.set_label(label, color="0.2")
        scale.outline.set_visible(False)
    ends = _measure(camera, ground, square)
    axes.plot(*ends.T, color="0.2", lw=2.5, solid_capstyle="butt", scalex=False, scaley=False)
    below = ends.mean(axis=0) + np.array([0, 0.03 * pixels[1]])
    axes.text(*below, f"{square:g} m", ha="center", va="top", color="0.2")

    def draw(particles: Particles, values: np.ndarray, t: float) -> None:
        x, (rock, normal) = place(particles.x), stones(t)
        about, slope = surroundings(x, volume, ground)
        colour = _tinted(particles, bar, values)
        balls = Balls(
            np.concatenate([x, rock]),
            np.concatenate([radius, np.full(len(rock), 1.5 * spacing)]),
            np.concatenate([colour, np.tile(STONE, (len(rock), 1))]),
            np.concatenate([slope, 10 * normal]),
        )
        image.set_data(picture(camera, light, balls, about=about, ground=ground, square=square))
        time.set_text(f"t = {t:.4g} s")

    return figure, draw


def _measure(camera: Camera, ground: float, square: float) -> np.ndarray:
    """Where the ends of a side of the ground's squares appear [pixels], (2, 2): the more level of the two, in the lower
    left of the picture."""
    size = np.array([camera.width, camera.height])
    goal = np.array([0.17, 0.89]) * size
    ray = (goal - size / 2) / camera.focal @ camera.axes[:2] + camera.axes[2]
    node = camera.eye + ray * (ground - camera.eye[2]) / ray[2]
    node[:2] = np.round(node[:2] / square) * square
    side = np.eye(3)[int(np.abs(camera.axes[0, :2]).argmax())] * square
    near = [node + square * np.array([i, j, 0]) for i in range(-2, 3) for j in range(-2, 3)]
    ends = [camera.project(np.stack([at, at + side]))[0] for at in near]
    return min(ends, key=lambda p: float(np.abs((p - goal) / size).sum()))


def _flat_canvas(run: Run, bar: Any, label: str) -> tuple[Any, Draw]:
    """A figure of one or two dimensions with axes that hold every frame, and what draws one."""
    from matplotlib import pyplot as plt
    from matplotlib.collections import EllipseCollection

    assert run.frames is not None
    d = run.final.dim
    x = np.asarray(run.frames.x).reshape(-1, d)
    volume = np.asarray(run.final.volume, float)
    margin = float(volume.mean()) ** (1 / d)
    lower, upper = x.min(axis=0) - 2 * margin, x.max(axis=0) + 2 * margin
    extent = float((upper - lower).max())
    walls = list(_walls(run.scene))
    for axis, at, *_ in walls:  # those near by are shown
        if lower[axis] - extent < at < upper[axis] + extent:
            lower[axis], upper[axis] = min(lower[axis], at - 0.03 * extent), max(upper[axis], at + 0.03 * extent)
    for distance in _obstacles(run.scene, float(run.times[0])) if d == 2 else ():
        place = skin(distance, lower - extent / 2, upper + extent / 2, extent / 50)[0]
        lower = np.minimum(lower, place.min(axis=0, initial=np.inf) - 0.03 * extent)
        upper = np.maximum(upper, place.max(axis=0, initial=-np.inf) + 0.03 * extent)
    shape = 2.0 if d == 1 else float(np.clip((upper - lower)[0] / (upper - lower)[1], 0.5, 2.0))
    figure = plt.figure(figsize=(4.2 * shape + 1.6, 4.8), layout="constrained")
    axes: Any = figure.add_subplot()
    axes.set(xlabel="x [m]", xlim=(lower[0], upper[0]))
    axes.set(
        **{"yticks": [], "ylim": (-1, 1)}
        if d == 1
        else {"ylabel": "y [m]", "ylim": (lower[1], upper[1]), "aspect": "equal"}
    )
    for axis, at, side, _ in walls:
        line, span = (axes.axvline, axes.axvspan) if axis == 0 else (axes.axhline, axes.axhspan)
        line(at, color=STONE, lw=1.5, zorder=3)
        span(at, at - side * 1e3 * extent, color=STONE, alpha=0.35, lw=0)
    width = volume if d == 1 else 2 * np.sqrt(volume / np.pi)
    disks: Any = EllipseCollection(
        width, width, 0.0, units="x", offsets=np.zeros((1, 2)), offset_transform=axes.transData
    )
    axes.add_collection(disks)
    if bar is not None:
        figure.colorbar(bar, ax=axes, label=label)
    lattice = np.stack(np.meshgrid(*np.linspace(lower, upper, 200).T), axis=-1)
    stones: list[Any] = []

    def draw(particles: Particles, values: np.ndarray, t: float) -> None:
        place = np.asarray(particles.x)
        disks.set_offsets(place if d == 2 else np.column_stack([place, np.zeros(len(place))]))
        disks.set_facecolor(_tinted(particles, bar, values))
        while stones:
            stones.pop().remove()
        for distance in _obstacles(run.scene, t) if d == 2 else ():
            inside = distance(lattice.reshape(-1, d)).reshape(lattice.shape[:-1])
            stones.append(axes.contourf(*lattice.T.swapaxes(1, 2), inside, [-np.inf, 0.0], colors=[STONE]))
        axes.set_title(f"t = {t:.4g} s")

    return figure, draw
