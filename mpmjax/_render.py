"""Pictures of runs, with matplotlib."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mpmjax._checks import require
from mpmjax._diagnostics import volume_ratio
from mpmjax._particles import Particles
from mpmjax._run import Run

COLOURS: dict[str, tuple[str, Callable[[Run, Particles], Any]]] = {
    "speed": ("speed [m/s]", lambda run, q: np.linalg.norm(q.v, axis=1)),
    "volume": ("volume ratio J [-]", lambda run, q: volume_ratio(q)),
    "energy": ("elastic energy density [J/m³]", lambda run, q: run.scene.material.energy(q.deformation())),
}
"""What particles can be coloured by: a label and a value for each particle."""


def render(
    run: Run, path: str | Path, *, colour: str = "speed", frame: int | None = None, fps: int = 20, dpi: float = 120.0
) -> None:
    """Draw a run: one frame as a still (.png, .pdf, .svg) or all of them as an animation (.gif).

    Args:
        run: a run with frames.
        path: the picture to write; its suffix says of which kind.
        colour: "speed", "volume" or "energy".
        frame: which frame a still shows; counts from the end if negative. Default: the last.
        fps: frames a second of an animation.
        dpi: resolution.

    Raises:
        ValueError: a run without frames, an unknown suffix or colour, a frame that is not there.
    """
    path = Path(path)
    suffixes = (".png", ".pdf", ".svg", ".gif")
    require(path.suffix in suffixes, f"A picture's name must end in one of {', '.join(suffixes)}, got {path.name!r}.")
    require(colour in COLOURS, f"colour must be one of {', '.join(COLOURS)}, got {colour!r}.")
    require(len(run) > 0, "The run has no frames to draw: pass save_every to simulate.")
    require(
        frame is None or -len(run) <= frame < len(run), f"The run has {len(run)} frames, there is no frame {frame}."
    )
    still = path.suffix != ".gif"
    shown = [len(run) - 1 if frame is None else frame % len(run)] if still else range(len(run))
    label, value = COLOURS[colour]
    values = [np.asarray(value(run, run.frame(i))) for i in shown]
    from matplotlib import animation  # here, since it takes a second that only pictures should pay
    from matplotlib import pyplot as plt

    figure, draw = _canvas(run, label, min(v.min() for v in values), max(v.max() for v in values))

    def show(k: int) -> None:
        draw(run.frame(shown[k]), values[k], float(run.times[shown[k]]))

    try:
        if still:
            show(0)
            figure.savefig(path, dpi=dpi, bbox_inches="tight")
        else:
            movie = animation.FuncAnimation(figure, lambda k: show(k) or [], frames=len(values), init_func=lambda: [])
            movie.save(path, writer=animation.PillowWriter(fps=fps), dpi=dpi)
    finally:
        plt.close(figure)


def _canvas(
    run: Run, label: str, low: float, high: float
) -> tuple[Any, Callable[[Particles, np.ndarray, float], None]]:
    """A figure with axes that hold every frame, and what draws one."""
    from matplotlib import pyplot as plt

    assert run.frames is not None
    d = run.final.dim
    x = np.asarray(run.frames.x).reshape(-1, d)
    size = float(np.mean(np.asarray(run.final.volume))) ** (1 / d)
    lower, upper = x.min(axis=0) - 2 * size, x.max(axis=0) + 2 * size
    figure = plt.figure(figsize=(6.4, 4.8), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d" if d == 3 else None)
    axes.set(xlabel="x [m]", xlim=(lower[0], upper[0]))
    if d == 1:
        axes.set(yticks=[], ylim=(-1, 1))
    else:
        axes.set(ylabel="y [m]", ylim=(lower[1], upper[1]), aspect="equal")
    if d == 3:
        axes.set(zlabel="z [m]", zlim=(lower[2], upper[2]), aspect="equal")
    dots = axes.scatter(*[x[:1, a] for a in range(d)], *([[0.0]] if d == 1 else []), c=[low], vmin=low, vmax=high)
    figure.colorbar(dots, label=label)
    figure.draw_without_rendering()
    box = axes.get_window_extent().transformed(figure.dpi_scale_trans.inverted())
    points_per_metre = 72 * min(
        box.width / (upper[0] - lower[0]), box.height / (upper[-1] - lower[-1]) if d > 1 else 1e9
    )
    dots.set_sizes([max((size * points_per_metre) ** 2, 1.0)])

    def draw(particles: Particles, values: np.ndarray, time: float) -> None:
        place = np.asarray(particles.x)
        if d == 3:
            dots._offsets3d = tuple(place.T)
        else:
            dots.set_offsets(place if d == 2 else np.column_stack([place, np.zeros(len(place))]))
        dots.set_array(values)
        axes.set_title(f"t = {time:.4g} s")

    return figure, draw
