"""Notebooks' views of a scene, a run and a fit: `_repr_html_`, which this file gives their classes."""

import base64
import html
import io
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from mpmjax.fitting import FitResult
from mpmjax.simulation import Fault, Run
from mpmjax.state import Scene
from mpmjax.viz._render import render

_DPI = 80.0  # of pictures in notebooks


def _image(png: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _rows(rows: dict[str, str]) -> str:
    cells = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows.items())
    return f"<table>{''.join(cells)}</table>"


def _short(value: Any) -> str:
    """A value with its numbers, and of larger arrays their types and shapes."""
    plain = jax.tree.map(lambda a: float(f"{np.asarray(a):.6g}") if np.ndim(a) == 0 else a, value)
    return " ".join(eqx.tree_pformat(plain).split()).replace("( ", "(").replace(" )", ")")


def scene_html(scene: Scene) -> str:
    """A table of what the scene contains."""
    values = {field.name: getattr(scene, field.name) for field in fields(scene)}
    empty = (None, (), False)
    return _rows({name: _short(value) for name, value in values.items() if not any(value is e for e in empty)})


def run_html(run: Run) -> str:
    """The last frame, and a line on the steps; of several runs at once, or without frames, the line alone."""
    if np.ndim(run.final_step):
        return _rows({"runs": str(np.shape(run.final_step)), "method": _short(run.method)})
    dt, steps, fault = float(run.dt), int(run.final_step), Fault(int(run.statistics.fault))
    rows = {"steps": f"{steps} of {dt:.4g} s, {len(run)} frames", "method": _short(run.method)}
    table = _rows(rows | ({} if fault == Fault.NONE else {"fault": fault.name}))
    if not len(run):
        return table
    with tempfile.TemporaryDirectory() as folder:
        render(run, Path(folder) / "frame.png", dpi=_DPI)
        return _image((Path(folder) / "frame.png").read_bytes()) + table


def fit_html(result: FitResult) -> str:
    """The table of the fit, and its picture."""
    from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

    drawn, figure = io.BytesIO(), result.plot()[0].figure
    figure.savefig(drawn, format="png", dpi=_DPI)
    plt.close(figure)
    return f"<pre>{html.escape(str(result))}</pre>{_image(drawn.getvalue())}"


for kind, view in ((Scene, scene_html), (Run, run_html), (FitResult, fit_html)):
    kind._repr_html_ = view  # pyright: ignore[reportAttributeAccessIssue]
