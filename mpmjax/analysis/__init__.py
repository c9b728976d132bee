"""Energy and momentum, their budgets, growth of derivatives, error against seconds."""

from mpmjax.analysis._bench import Build, Trial, name_of
from mpmjax.analysis._budget import Budget, EnergyBudget, MomentumBudget, budget
from mpmjax.analysis._diagnostics import (
    Energy,
    energy,
    energy_density,
    energy_of,
    grid_mass,
    momentum,
    pieces,
    volume_ratio,
)
from mpmjax.analysis._sensitivity import Sensitivity, sensitivity
from mpmjax.analysis._work_precision import METHODS, WorkPrecision, work_precision

__all__ = [
    "METHODS",
    "Budget",
    "Build",
    "Energy",
    "EnergyBudget",
    "MomentumBudget",
    "Sensitivity",
    "Trial",
    "WorkPrecision",
    "budget",
    "energy",
    "energy_density",
    "energy_of",
    "grid_mass",
    "momentum",
    "name_of",
    "pieces",
    "sensitivity",
    "volume_ratio",
    "work_precision",
]
