"""Energy, momentum, stress, their budgets, growth of derivatives, error against seconds."""

from mpmjax.analysis._bench import Build as Build, Trial as Trial, name_of as name_of
from mpmjax.analysis._budget import (
    Budget as Budget,
    Energy as Energy,
    EnergyBudget as EnergyBudget,
    MomentumBudget as MomentumBudget,
    budget as budget,
    energy as energy,
    energy_density as energy_density,
    energy_of as energy_of,
    grid_mass as grid_mass,
    momentum as momentum,
    pieces as pieces,
    volume_ratio as volume_ratio,
)
from mpmjax.analysis._sensitivity import Sensitivity as Sensitivity, sensitivity as sensitivity
from mpmjax.analysis._stress import (
    FIELDS as FIELDS,
    density as density,
    fields_of as fields_of,
    pressure as pressure,
    smoothed as smoothed,
    stress as stress,
    von_mises as von_mises,
)
from mpmjax.analysis._work_precision import (
    METHODS as METHODS,
    WorkPrecision as WorkPrecision,
    work_precision as work_precision,
)
