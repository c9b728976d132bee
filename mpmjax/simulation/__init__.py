"""Rollouts: many steps, driven by diffrax, and their faults in words."""

from mpmjax.simulation._faults import (
    LARGEST_LINEARISATION_ERROR as LARGEST_LINEARISATION_ERROR,
    raise_faults as raise_faults,
    warn_of_inaccuracy as warn_of_inaccuracy,
)
from mpmjax.simulation._rollout_state import RolloutState as RolloutState, initial_state as initial_state
from mpmjax.simulation._run import Run as Run, SimulationError as SimulationError
from mpmjax.simulation._simulate import (
    before_fault as before_fault,
    integrate as integrate,
    number_of_steps as number_of_steps,
    rollout as rollout,
    simulate as simulate,
)
from mpmjax.simulation._statistics import Fault as Fault, RunStatistics as RunStatistics, no_steps as no_steps
