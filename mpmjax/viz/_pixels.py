"""Pixels: of disks, and of the frames of a film, whose axes are drawn once, written as they are made."""

import subprocess
from collections.abc import Callable, Iterator
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


def disks(size: tuple[int, int], place: np.ndarray, radius: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """A picture (h, w, 4) of disks, the later ones over the earlier ones, with smooth edges, by twice the size.

    Args:
        size: w and h [pixels].
        place, radius: of each disk [pixels], (n, 2) from the upper left and (n,).
        colour: from 0 to 1, (n, 3).
    """
    w, h = size
    whole = np.maximum(np.round(2 * radius).astype(int), 1)
    m = int(whole.max()) + 1  # a margin, so that no disk's pixels need a check
    at = np.floor(2 * place).astype(int) + m
    ranks = np.flatnonzero((at >= 0).all(axis=1) & (at < (2 * w + 2 * m, 2 * h + 2 * m)).all(axis=1))
    wide = 2 * w + 4 * m
    top = np.zeros((2 * h + 4 * m) * wide, np.int32)  # the number of the last disk over each pixel, from 1
    for r in np.unique(whole[ranks]):
        layer, alike = np.zeros_like(top), ranks[whole[ranks] == r]
        x, y = np.meshgrid(*[np.arange(-r, r + 1)] * 2)
        inside = (y * wide + x)[x**2 + y**2 <= r**2]
        many = max(1, 2**21 // len(inside))  # so many disks at a time, to bound the memory
        for some in np.split(alike, range(many, len(alike), many)):
            pixels: Any = (at[some] + m) @ (1, wide)
            layer[pixels[:, None] + inside] = some[:, None] + 1  # of a pixel's numbers the last one stays
        np.maximum(top, layer, out=top)
    tint = np.zeros((len(colour) + 1, 4), np.uint8)
    tint[1:] = np.column_stack([255 * colour, np.full(len(colour), 255)])
    seen = top.reshape(-1, wide)[2 * m : 2 * m + 2 * h, 2 * m : 2 * m + 2 * w]
    four = np.stack([tint[seen[i::2, j::2]] for i in (0, 1) for j in (0, 1)]).astype(np.uint16).sum(axis=0)
    covered = np.maximum(four[..., 3:] // 255, 1)
    return np.concatenate([four[..., :3] // covered, four[..., 3:] // 4], axis=-1).astype(np.uint8)
