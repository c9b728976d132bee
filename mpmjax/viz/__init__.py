"""Pictures of runs and charts."""

from mpmjax.viz._chart import draw_chart, write_trials
from mpmjax.viz._fit_report import draw_fit, write_fit
from mpmjax.viz._render import COLOURS, render

__all__ = ["COLOURS", "draw_chart", "draw_fit", "render", "write_fit", "write_trials"]
