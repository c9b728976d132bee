"""One step: what particles bring to the nodes, the grid's updates, contact, and the longest stable step."""

from mpmjax.stepping._grid_update import GridUpdate as GridUpdate, reaction as reaction
from mpmjax.stepping._implicit_integrators import (
    TRBDF2 as TRBDF2,
    BackwardEuler as BackwardEuler,
    ImplicitMidpoint as ImplicitMidpoint,
    SemiImplicit as SemiImplicit,
)
from mpmjax.stepping._integrator import (
    AbstractIntegrator as AbstractIntegrator,
    Explicit as Explicit,
    NodeMotion as NodeMotion,
)
from mpmjax.stepping._nodes import Nodes as Nodes, start_nodes as start_nodes
from mpmjax.stepping._stability import (
    MOST_STEPS as MOST_STEPS,
    SAFETY as SAFETY,
    UnknownBoundError as UnknownBoundError,
    longest_step as longest_step,
    stable_dt as stable_dt,
    step_for as step_for,
)
from mpmjax.stepping._step import (
    StepInfo as StepInfo,
    grid_to_particles as grid_to_particles,
    step as step,
    step_compiled as step_compiled,
    step_unchecked as step_unchecked,
    update as update,
)
