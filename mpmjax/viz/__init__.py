"""Pictures of runs and charts."""

from mpmjax.viz._chart import draw_chart, write_trials
from mpmjax.viz._render import COLOURS, render

__all__ = ["COLOURS", "draw_chart", "render", "write_trials"]
