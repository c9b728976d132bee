"""One step: what particles bring to the nodes, the grid's updates, contact, and the longest stable step."""

from mpmjax.stepping._method import TRBDF2, BackwardEuler, Explicit, ImplicitMidpoint, Method, SemiImplicit, reporting
from mpmjax.stepping._nodes import Nodes, particles_to_grid
from mpmjax.stepping._stability import MOST_STEPS, SAFETY, longest_step, stable_dt, step_for
from mpmjax.stepping._step import GridUpdate, StepInfo, advance, advance_compiled, grid_to_particles, step, update

__all__ = [
    "MOST_STEPS",
    "SAFETY",
    "TRBDF2",
    "BackwardEuler",
    "Explicit",
    "GridUpdate",
    "ImplicitMidpoint",
    "Method",
    "Nodes",
    "SemiImplicit",
    "StepInfo",
    "advance",
    "advance_compiled",
    "grid_to_particles",
    "longest_step",
    "particles_to_grid",
    "reporting",
    "stable_dt",
    "step",
    "step_for",
    "update",
]
