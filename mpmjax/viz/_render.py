"""Pictures and films of runs: deformed squares in two dimensions, shaded balls in three, on axes of matplotlib."""

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

from mpmjax.analysis import FIELDS, smoothed, volume_ratio
from mpmjax.checks import between, canonical, checked, require, require_memory
from mpmjax.io import replacing, save_figure
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene, history_arrays
from mpmjax.viz._picture import film_pictures, gaps, outward, skin, write_film

COLOURS: dict[str, tuple[str, Callable[[Scene, Particles], Any]]] = {
    **{name: field for name, field in FIELDS.items() if name != "stress"},
    "J": ("volume ratio J [-]", lambda scene, q: volume_ratio(q)),
}
"""The quantities that can colour particles: a label, and a value for each particle."""
_SMOOTHED = ("pressure", "von_mises")  # they oscillate from particle to particle

SNOW, OCHRE, STEEL, MOSS = (0.91, 0.93, 0.96), (0.82, 0.55, 0.33), (0.36, 0.5, 0.66), (0.45, 0.62, 0.42)
STONE = (0.55, 0.54, 0.52)  # the colour of walls and colliders

Draw = Callable[[Particles, np.ndarray, float], list[Any]]
"""Draws particles, with their values, at a time [s], and returns all that differs from frame to frame."""


@checked
def render(
    run: Run,
    path: str | Path,
    *,
    colour: str | None = "speed",
    frame: int | None = None,
    view: tuple[float, float] = (30.0, 20.0),
    fps: Annotated[int, between(1, 100)] = 20,  # a GIF counts hundredths of a second
    dpi: Annotated[float, between(1, 6000)] = 120.0,  # matplotlib draws fewer than 2^16 pixels a side
) -> None:
    """Draw a run: one frame as a still (.png, .pdf, .svg) or all of them as a film (.gif, or .mp4 where ffmpeg is).

    In two dimensions particles are squares of their undeformed volume that deform with them and so fill the body; where
    a law yields or flows, F has lost the shape, and gaps of less than four widths are filled. Walls are lines. In three
    they are balls sorted by depth, half as large again, so that they close into a body, and shaded by its surface in a
    light from the upper left; up is against gravity's largest component (the last axis without gravity), and the ground
    is the highest wall or plane that bears, else a little below the particles. All frames have the same view and scale.
    Colours go from the 1st to the 99th percentile of all values shown, as the bar's label says where some lie beyond.

    Args:
        run: a run with frames.
        path: the picture to write; its suffix says of which kind.
        colour: "speed", "J", "energy", "pressure", "von_mises", "density", "mass", "volume", "particle", or the name
            of what a law remembers, such as snow's "plastic_volume"; "material", "none" or None for materials in
            colours of their own, named where there are several. Pressure and von Mises stress are averages over the
            particles around (`analysis.smoothed`).
        frame: which frame a still shows; counts from the end if negative. Default: the last.
        view: in three dimensions, azimuth and elevation of the eye [degrees]. At azimuth 0 the first horizontal axis
            points to the right; the elevation is above 0 and at most 90.
        fps: frames a second of a film, from 1 to 100.
        dpi: resolution [dots an inch], from 1 to 6000.

    Raises:
        ValueError: a run without frames or particles, an unknown suffix or colour, a frame that is not there, an
            elevation that is not above the ground.
    """
    path = Path(path)
    suffixes = (".png", ".pdf", ".svg", ".gif", ".mp4")
    require(path.suffix in suffixes, f"A picture's name must end in one of {', '.join(suffixes)}, got {path.name!r}.")
    colour = None if colour in ("none", "material") else colour
    require(len(run) > 0, "The run has no frames to draw: pass save_every to simulate.")
    quantities = COLOURS | {
        name: (name.replace("_", " "), partial(_remembered, name)) for name, *_ in history_arrays(run.final)
    }
    fits = colour is None or colour in quantities
    require(fits, f"colour must be one of {', '.join(quantities)}, none, got {colour!r}.")
    require(run.final.count > 0, "The run has no particles to draw.")
    require(
        frame is None or -len(run) <= frame < len(run), f"The run has {len(run)} frames, there is no frame {frame}."
    )
    still = path.suffix not in (".gif", ".mp4")
    require(frame is None or still, f"frame is for a still; a {path.suffix} shows all frames.")
    can_be = path.suffix != ".mp4" or shutil.which("ffmpeg")
    require(can_be, "A .mp4 needs the program ffmpeg, which is not there: install it, or write a .gif.")
    require_memory(f"A picture of {dpi:g} dots an inch", 64 * 8 * 6 * dpi**2, "take a smaller dpi.")
    between(-360, 360)("view's azimuth [degrees]", view[0])
    between(0.1, 90)("view's elevation [degrees]", view[1])
    shown = [len(run) - 1 if frame is None else frame % len(run)] if still else range(len(run))
    label, value = ("", lambda scene, q: np.full(q.count, np.nan)) if colour is None else quantities[colour]
    values = np.stack([np.asarray(value(run.scene, run.frame(i)), float) for i in shown])
    if colour in _SMOOTHED:
        each = [jnp.asarray(a, run.final.x.dtype) for a in values]
        values = np.stack([np.asarray(smoothed(run.scene, run.frame(i), a)) for i, a in zip(shown, each, strict=True)])
    there = np.stack([np.asarray(run.frame(i).mass) > 0 for i in shown])
    values = np.where(there, values, np.nan)
    from matplotlib import cm, colormaps, colors, pyplot as plt  # here: it takes a second that only pictures should pay

    bar = None
    if colour is not None and there.any():
        least, most = np.nanmin(values), np.nanmax(values)
        low, high = (least, most) if colour == "particle" else np.nanpercentile(values, (1, 99))
        low, high = (low, high) if low < high else (least, most)
        colours: Any = colormaps["viridis"].copy()
        colours.colorbar_extend = ("neither", "max", "min", "both")[2 * bool(least < low) + bool(most > high)]
        label += ", 1st to 99th percentile" * (colours.colorbar_extend != "neither")
        bar = cm.ScalarMappable(colors.Normalize(low, high), colours)
    figure, draw = _solid_canvas(run, bar, label, view) if run.final.dim == 3 else _flat_canvas(run, bar, label)
    figure.set_dpi(dpi)

    def show(k: int) -> list[Any]:
        return draw(run.frame(shown[k]), values[k], float(run.times[shown[k]]))

    try:
        if still:
            show(0)
            save_figure(figure, path, dpi)
        else:
            with replacing(path) as aside:
                write_film(film_pictures(figure, show, len(values)), aside, fps)
    finally:
        plt.close(figure)


def _remembered(name: str, scene: Any, particles: Particles) -> np.ndarray:
    """The history variable of that name; NaN at particles whose law has none."""
    values = np.full(particles.count, np.nan)
    for remembered, rows, leaf in history_arrays(particles):
        if remembered == name:
            values[rows] = leaf
    return values


def _volume(run: Run) -> np.ndarray:
    """The undeformed volumes [m^d], (p,); of particles that enter or leave, those while they are there."""
    assert run.frames is not None
    changing = run.frames.volume
    return np.asarray(run.final.volume if changing is None else np.asarray(changing).max(axis=0), float)


def _places(run: Run) -> np.ndarray:
    """Where particles are in any frame [m], (n, d), without those that have no mass then."""
    assert run.frames is not None
    x = np.asarray(run.frames.x, float)
    there = np.ones(x.shape[:2], bool) if run.frames.mass is None else np.asarray(run.frames.mass) > 0
    return x[there] if there.any() else x.reshape(-1, x.shape[-1])


def _colour_of(material: int, d: int) -> tuple[float, float, float]:
    """The colour of a material that has no values."""
    palette = (SNOW, OCHRE, STEEL, MOSS) if d == 3 else (STEEL, OCHRE, MOSS, SNOW)
    return palette[material % len(palette)]


def _legend(axes: Any, scene: Scene) -> None:
    """Name the materials by their colours, where there are several."""
    from matplotlib.patches import Patch

    colours = [_colour_of(i, scene.grid.dim) for i in range(len(scene.laws))]
    patches = [Patch(facecolor=c, edgecolor="0.5", label=t) for c, t in zip(colours, scene.titles, strict=True)]
    if len(patches) > 1:
        axes.legend(handles=patches, loc="upper right", fontsize=8).set_zorder(5)


def _tinted(particles: Particles, bar: Any, values: np.ndarray) -> np.ndarray:
    """The particles' colours, (p, 3): by their values, and where there are none by their material."""
    colours = np.empty((particles.count, 3))
    for i, group in enumerate(particles.groups):
        colours[group.rows] = _colour_of(i, particles.dim)
    if bar is None:
        return colours
    return np.where(np.isnan(values)[:, None], colours, bar.to_rgba(values)[:, :3])


def _obstacles(scene: Scene, t: float) -> Iterator[Callable[[np.ndarray], np.ndarray]]:
    """The signed distance [m] of points [m], (m, d), to each body where it is at time t."""
    dtype = jnp.zeros(()).dtype
    nowhere = jnp.zeros((0, scene.grid.dim), dtype)
    for boundary in canonical(scene.boundary, dtype):
        if boundary.distance(nowhere, t) is not None:
            yield lambda x, body=boundary: np.asarray(body.distance(jnp.asarray(x, dtype), t))


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
    walls = (w for b in scene.boundary for w in b.walls() if w.axis == axis and w.inward == up[axis])
    return max((float(up[axis]) * wall.position for wall in walls), default=None)


def _solid_canvas(run: Run, bar: Any, label: str, view: tuple[float, float]) -> tuple[Any, Draw]:
    """A figure of three dimensions with axes that hold every frame, and what draws one."""
    from matplotlib import pyplot as plt
    from mpl_toolkits.mplot3d import proj3d

    turn, volume, x = _upright(run.scene), _volume(run), _places(run)
    size = float(volume.sum() / max(np.count_nonzero(volume), 1)) ** (1 / 3)
    lower, upper = x.min(axis=0) - size, x.max(axis=0) + size
    extent = float((upper - lower).max())
    room, spacing = (lower - extent / 2, upper + extent / 2), max(size, extent / 50)
    diameter = 2.3 * (3 * volume / (4 * np.pi)) ** (1 / 3)  # so large that they close into a body

    def stones(t: float) -> tuple[np.ndarray, np.ndarray]:
        """The obstacles' skins, below the surface by the radius of their balls, and their normals."""
        skins = [skin(distance, *room, spacing) for distance in _obstacles(run.scene, t)]
        turned = [((x - 1.5 * spacing * n) @ turn.T, n @ turn.T) for x, n in skins]
        x, n = zip((np.zeros((0, 3)), np.zeros((0, 3))), *turned, strict=True)
        return np.concatenate(x), np.concatenate(n)

    bearing = _bearing(run.scene, turn[2])
    everything = np.concatenate([x @ turn.T, stones(float(run.times[0]))[0]])
    lower, upper = everything.min(axis=0) - size, everything.max(axis=0) + size
    ground = float(lower[2] if bearing is None else bearing)
    lower[2] = min(lower[2], ground)
    figure = plt.figure(figsize=(8, 6))
    axes = _solid_axes(figure, lower, upper, turn, view)
    title = axes.set_title(" ")
    azimuth, elevation = np.radians(view)
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    ends = np.stack([(lower + upper) / 2 - right * size, (lower + upper) / 2 + right * size])
    over: Any = figure.add_axes((0, 0, 1, 1), xlim=(0, 1), ylim=(0, 1), zorder=4)
    over.axis("off")
    balls = over.scatter([], [], linewidths=0, rasterized=True)  # and their shadows

    def on_paper(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pixels of points, (n, 2), and how far they are."""
        across, along, depth = proj3d.proj_transform(x[:, 0], x[:, 1], x[:, 2], axes.get_proj())
        return axes.transData.transform(np.stack([across, along], axis=1)), np.asarray(depth)

    if bar is not None:  # as high as the box of the axes is on paper
        corners = np.stack(np.meshgrid(*np.stack([lower, upper], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
        heights = on_paper(corners)[0][:, 1] / figure.bbox.height
        place = (0.88, heights.min(), 0.018, np.ptp(heights))
        figure.colorbar(bar, cax=figure.add_axes(place), label=label)
    else:
        _legend(axes, run.scene)
    back = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    light = 0.55 * back - 0.45 * right + np.array([0, 0, 0.7])  # from the upper left
    light = light / np.linalg.norm(light)

    def draw(particles: Particles, values: np.ndarray, t: float) -> list[Any]:
        x, (rock, normal) = np.asarray(particles.x, float) @ turn.T, stones(t)
        there = np.asarray(particles.mass) > 0
        normals = np.zeros_like(x)
        if there.any():
            normals[there] = outward(x[there], volume[there])
        normals = np.concatenate([normals, normal])
        facing = (normals @ light)[:, None]
        colour = np.concatenate([_tinted(particles, bar, values), np.tile(STONE, (len(rock), 1))])
        colour = np.clip(colour * np.where(facing > 0, 0.75 + 0.3 * facing, 0.75 + 0.4 * facing), 0, 1)
        wide = np.concatenate([diameter * there, np.full(len(rock), 3 * spacing)])
        every = np.concatenate([x, rock])
        shadow = np.column_stack([every[:, :2], np.full(len(every), ground)])
        metre = float(np.linalg.norm(np.diff(on_paper(ends)[0], axis=0))) / (2 * size)  # in pixels, at the middle
        (flat, _), (place, depth) = on_paper(shadow), on_paper(every)
        order = np.argsort(-depth)
        balls.set_offsets(np.concatenate([flat, place[order]]) / figure.bbox.size)
        balls.set_sizes((np.concatenate([wide, wide[order]]) * metre * 72 / figure.dpi) ** 2)  # in points
        balls.set_facecolor(np.concatenate([np.full((len(flat), 3), 0.8), colour[order]]))
        title.set_text(f"t = {t:.4g} s")
        return [balls, title]

    return figure, draw


def _solid_axes(figure: Any, lower: np.ndarray, upper: np.ndarray, turn: np.ndarray, view: tuple[float, float]) -> Any:
    """Axes of a box between two corners [m], each direction named by the scene's, whose labels do not overlap."""
    from matplotlib import ticker

    axes: Any = figure.add_axes((0.02, 0.03, 0.82, 0.9), projection="3d", computed_zorder=False)
    names = ["−" * bool(row.min() < 0) + "xyz"[int(np.abs(row).argmax())] for row in turn]
    axes.set(**{f"{a}lim": limits for a, limits in zip("xyz", np.stack([lower, upper], axis=1), strict=True)})
    axes.set(**{f"{a}label": f"{name} [m]" for a, name in zip("xyz", names, strict=True)})
    sides = upper - lower
    slender = float(sides.max() / np.linalg.norm(sides))  # matplotlib makes the diagonal of every box as long
    axes.set_box_aspect(sides, zoom=min(1.0, 0.66 / slender))
    axes.view_init(view[1], view[0] - 90)
    each = axes.xaxis, axes.yaxis, axes.zaxis
    for axis, side in zip(each, sides / sides.max(), strict=True):
        axis.pane.set_visible(axis is axes.zaxis)
        away = float(sides.max() / sides[:2].mean()) if axis is axes.zaxis else 1.0  # pads shrink with the sides
        axis.set_tick_params(pad=11 * away - 8)
        axis.labelpad = 25 * away - 21
        axis.set_major_locator(ticker.MaxNLocator(max(2, round(5 * side))))  # labels of a short side would overlap
    figure.canvas.draw()
    taken: list[Any] = []  # where two axes meet, a label that would lie over another one is left out
    for tick in (tick for axis in each for tick in axis.majorTicks):
        box = tick.label1.get_window_extent()
        tick.label1.set_visible(not any(box.overlaps(other) for other in taken))
        taken += [box] * tick.label1.get_visible()
    return axes


def _flat_canvas(run: Run, bar: Any, label: str) -> tuple[Any, Draw]:
    """A figure of one or two dimensions with axes that hold every frame, and what draws one."""
    from matplotlib import pyplot as plt
    from matplotlib.collections import PolyCollection

    assert run.frames is not None
    d, grid = run.final.dim, run.scene.grid
    volume = np.asarray(grid.section(run.frames.x[0], jnp.asarray(_volume(run))), float)

    def whole(x: np.ndarray) -> np.ndarray:
        """Points with those on the other side of the axis of a body of revolution."""
        return np.concatenate([x, x * (-1, 1)]) if grid.axisymmetric else x

    x = whole(_places(run))
    margin = float(volume.sum() / max(np.count_nonzero(volume), 1)) ** (1 / d)
    lower, upper = x.min(axis=0) - 2 * margin, x.max(axis=0) + 2 * margin
    extent = float((upper - lower).max())
    walls = [wall for boundary in run.scene.boundary for wall in boundary.walls()]
    if grid.axisymmetric:
        around = [wall for wall in walls if wall.axis == 0 and wall.position != 0]
        across = [wall._replace(position=-wall.position, inward=-wall.inward) for wall in around]
        walls = [wall for wall in walls if wall.axis == 1] + around + across
    for axis, at, *_ in walls:  # those near by are shown
        if lower[axis] - extent < at < upper[axis] + extent:
            lower[axis], upper[axis] = min(lower[axis], at - 0.03 * extent), max(upper[axis], at + 0.03 * extent)
    for distance in _obstacles(run.scene, float(run.times[0])) if d == 2 else ():
        place = skin(distance, lower - extent / 2, upper + extent / 2, extent / 50)[0]
        lower = np.minimum(lower, place.min(axis=0, initial=np.inf) - 0.03 * extent)
        upper = np.maximum(upper, place.max(axis=0, initial=-np.inf) + 0.03 * extent)
    ratio = 2.0 if d == 1 else float((upper - lower)[0] / (upper - lower)[1])
    wide = 4.2 * np.clip(ratio, 0.5, 2.0)
    figure = plt.figure(figsize=(wide + 1.6, np.clip(wide / ratio, 1.6, 4.2) + 0.6), layout="constrained")
    axes: Any = figure.add_subplot()
    axes.set(xlabel="r [m]" if grid.axisymmetric else "x [m]", xlim=(lower[0], upper[0]))
    axes.set(
        **{"yticks": [], "ylim": (-1, 1)}
        if d == 1
        else {"ylabel": "z [m]" if grid.axisymmetric else "y [m]", "ylim": (lower[1], upper[1]), "aspect": "equal"}
    )
    for axis, at, side, _ in walls:
        line, span = (axes.axvline, axes.axvspan) if axis == 0 else (axes.axhline, axes.axhspan)
        line(at, color=STONE, lw=1.5, zorder=3)
        span(at, at - side * 1e3 * extent, color=STONE, alpha=0.35, lw=0)
    half = np.stack([volume / 2, np.full(len(volume), 0.1)] if d == 1 else [np.sqrt(volume) / 2] * 2, axis=1)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[:, None]
    squares: Any = PolyCollection([], linewidths=0, antialiaseds=False)  # whose edges would show between them
    axes.add_collection(squares, autolim=False)
    title = axes.set_title(" ")
    if bar is not None:
        figure.colorbar(bar, cax=axes.inset_axes((1.03, 0, 0.04, 1)), label=label)
    else:
        _legend(axes, run.scene)
    lattice = np.stack(np.meshgrid(*np.linspace(lower, upper, 200).T), axis=-1)
    stones: list[Any] = []

    def draw(particles: Particles, values: np.ndarray, t: float) -> list[Any]:
        place, F = np.zeros((particles.count, 2)), np.tile(np.eye(2), (particles.count, 1, 1))
        place[:, :d] = particles.x
        present, flows = np.asarray(particles.mass) > 0, np.zeros(particles.count, bool)
        for (rows, stored, _), law in zip(particles.groups, run.scene.laws, strict=True):
            a = np.asarray(stored)
            F[rows, :d, :d] = a[:, :d, :d] if a.ndim == 3 else a[:, None, None] ** (1 / d) * np.eye(d)
            if a.ndim == 1 or law.relaxes_stress:  # F does not say how they are stretched
                flows[rows] = present[rows]
                F[rows] *= 3 - d  # in one dimension they overlap
        F *= present[:, None, None]  # others are not there
        colours = np.tile(_tinted(particles, bar, values), (2 if grid.axisymmetric else 1, 1))
        square = whole(place[:, None] + np.einsum("pij,pkj->pki", F, corners))
        gap = gaps(whole(place), np.tile(flows, len(square) // len(flows)), 4 * margin)
        squares.set_verts(np.concatenate([whole(place)[gap], square]))
        squares.set_facecolor(np.concatenate([colours[gap].mean(axis=1), colours]))
        while stones:
            stones.pop().remove()
        for distance in _obstacles(run.scene, t) if d == 2 else ():
            there = lattice.reshape(-1, d)
            there = np.column_stack([np.abs(there[:, 0]), there[:, 1]]) if grid.axisymmetric else there
            inside = distance(there).reshape(lattice.shape[:-1])
            stones.append(axes.contourf(*lattice.T.swapaxes(1, 2), inside, [-np.inf, 0.0], colors=[STONE]))
        title.set_text(f"t = {t:.4g} s")
        return [squares, *stones, title]

    return figure, draw
