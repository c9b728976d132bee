"""Pictures of runs and charts."""

from mpmjax.viz._chart import draw_chart as draw_chart, write_fit as write_fit, write_trials as write_trials
from mpmjax.viz._notebook import fit_html as fit_html, run_html as run_html, scene_html as scene_html
from mpmjax.viz._render import COLOURS as COLOURS, render as render
