"""Rollouts: many steps, driven by diffrax, and their faults in words."""

from mpmjax.simulation._diffrax import (
    Control as Control,
    Problem as Problem,
    RolloutState as RolloutState,
    initial_state as initial_state,
    run_to as run_to,
)
from mpmjax.simulation._faults import (
    LARGEST_LINEARISATION_ERROR as LARGEST_LINEARISATION_ERROR,
    raise_faults as raise_faults,
    warn_of_inaccuracy as warn_of_inaccuracy,
)
from mpmjax.simulation._run import (
    Fault as Fault,
    Run as Run,
    RunStatistics as RunStatistics,
    SimulationError as SimulationError,
    no_steps as no_steps,
)
from mpmjax.simulation._simulate import (
    number_of_steps as number_of_steps,
    rollout as rollout,
    segment as segment,
    simulate as simulate,
)
