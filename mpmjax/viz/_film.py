"""The frames of a film, whose axes are drawn once, written as they are made."""

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
