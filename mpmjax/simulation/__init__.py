"""Rollouts: many steps, driven by diffrax, and their faults in words."""

from mpmjax.simulation._faults import LARGEST_LINEARISATION_ERROR, raise_faults, warn_of_inaccuracy
from mpmjax.simulation._rollout_state import RolloutState, initial_state
from mpmjax.simulation._run import Run, SimulationError
from mpmjax.simulation._simulate import before_fault, integrate, number_of_steps, rollout, simulate
from mpmjax.simulation._statistics import Fault, RunStatistics, no_steps

__all__ = [
    "LARGEST_LINEARISATION_ERROR",
    "Fault",
    "RolloutState",
    "Run",
    "RunStatistics",
    "SimulationError",
    "before_fault",
    "initial_state",
    "integrate",
    "no_steps",
    "number_of_steps",
    "raise_faults",
    "rollout",
    "simulate",
    "warn_of_inaccuracy",
]
