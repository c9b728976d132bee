"""The parts of pictures: frames of a film, written as they are made, skins of shapes, normals of bodies of particles,
and what lies between particles."""

import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np


def film_pictures(figure: Any, show: Callable[[int], list[Any]], count: int) -> Iterator[np.ndarray]:
    """The pixels of each of `count` frames, (h, w, 3). The axes are drawn once: only what `show` returns differs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    for artist in show(0):
        artist.set_animated(True)  # which leaves it out
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for k in range(count):
        canvas.restore_region(background)
        for artist in show(k):
            artist.axes.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def write_film(pictures: Iterator[np.ndarray], path: Path, fps: int) -> None:
    """Write a .gif or .mp4 while the pictures are drawn, so that no more than one is held with all its colours."""
    from PIL import Image

    if path.suffix == ".gif":
        first, *more = (Image.fromarray(a).quantize(method=Image.Quantize.FASTOCTREE) for a in pictures)
        first.save(path, save_all=True, append_images=more, duration=1000 / fps, loop=0)
        return
    first = next(pictures)
    size = f"{first.shape[1]}x{first.shape[0]}"
    even = "pad=ceil(iw/2)*2:ceil(ih/2)*2"  # which the format needs
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-"]
    command = ["ffmpeg", "-loglevel", "error", "-y", *source, "-vf", even, "-pix_fmt", "yuv420p", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            process.stdin.write(first.tobytes())
            for picture in pictures:
                process.stdin.write(picture.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # it says why
        message = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        raise OSError(f"ffmpeg: {message.splitlines()[-1] if message else 'it failed'}")


_MOST_CELLS = 90  # cells in a direction of the lattice by which particles are shaded


def skin(
    distance: Callable[[np.ndarray], np.ndarray], lower: np.ndarray, upper: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points on a shape's surface and its outward normals there, each (n, d), about a `spacing` apart [m], between
    two corners [m], (d,), from the signed distance to the shape [m] of points (m, d), negative inside."""
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(lower, upper, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    x = x[np.abs(distance(x)) < 0.5 * len(axes) ** 0.5 * spacing]
    steps = 1e-2 * spacing * np.eye(len(axes))
    normal = np.stack([distance(x + e) - distance(x - e) for e in steps], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(np.finfo(float).tiny)
    return x - distance(x)[:, None] * normal, normal


def outward(x: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """The outward normals of a body at its particles [-], (p, 3), at x [m]: about 1 long at its surface, 0 in its
    inside. They are the slope of how full the space is, on a lattice of cells as large as the particles."""
    from scipy import ndimage  # here, since it takes long to import

    lower, upper = x.min(axis=0), x.max(axis=0)
    cell = max(float(volume.mean()) ** (1 / 3), float((upper - lower).max()) / _MOST_CELLS)
    place = (x - lower) / cell + 3.5
    shape = tuple(((upper - lower) / cell).astype(int) + 8)
    index = np.ravel_multi_index(tuple(place.astype(int).T), shape)
    full = np.bincount(index, volume / cell**3, minlength=int(np.prod(shape))).reshape(shape)
    full = ndimage.gaussian_filter(full, 1.5)
    at = partial(ndimage.map_coordinates, coordinates=place.T - 0.5, order=1, mode="nearest")
    slope = np.stack([at(a) for a in np.gradient(full)], axis=1)
    normal = -1.5 * slope / np.maximum(at(full), 0.2)[:, None]
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1)


def gaps(x: np.ndarray, flows: np.ndarray, most: float) -> np.ndarray:
    """Triangles between the particles at x [m], (p, 2), that flow, (p,), whose edges are shorter than `most` [m]: the
    numbers of four corners, the last of which repeats, (n, 4)."""
    from scipy.spatial import Delaunay  # here, since it takes long to import

    if flows.sum() < 4:
        return np.zeros((0, 4), int)
    corners = np.flatnonzero(flows)[Delaunay(x[flows], qhull_options="QJ").simplices[:, [0, 1, 2, 2]]]
    edges = x[corners] - x[np.roll(corners, 1, axis=1)]
    return corners[np.linalg.norm(edges, axis=2).max(axis=1) < most]
