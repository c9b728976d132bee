"""One step: what particles bring to the nodes, the grid's updates, contact, and the longest stable step."""

from mpmjax.stepping._backward_euler import BackwardEuler
from mpmjax.stepping._explicit import Explicit
from mpmjax.stepping._grid_update import GridUpdate, reaction, update
from mpmjax.stepping._implicit_midpoint import ImplicitMidpoint
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes, start_nodes
from mpmjax.stepping._semi_implicit import SemiImplicit
from mpmjax.stepping._stability import MOST_STEPS, SAFETY, UnknownBoundError, longest_step, stable_dt, step_for
from mpmjax.stepping._step import StepInfo, grid_to_particles, step, step_compiled, step_unchecked
from mpmjax.stepping._trbdf2 import TRBDF2

__all__ = [
    "MOST_STEPS",
    "SAFETY",
    "TRBDF2",
    "AbstractIntegrator",
    "BackwardEuler",
    "Explicit",
    "GridUpdate",
    "ImplicitMidpoint",
    "NodeMotion",
    "Nodes",
    "SemiImplicit",
    "StepInfo",
    "UnknownBoundError",
    "grid_to_particles",
    "longest_step",
    "reaction",
    "stable_dt",
    "start_nodes",
    "step",
    "step_compiled",
    "step_for",
    "step_unchecked",
    "update",
]
