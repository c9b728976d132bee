"""Particles, scene and what a step needs of them."""

from mpmjax.state._body_force import AbstractBodyForce
from mpmjax.state._description import AbstractDescription, TotalLagrangian, UpdatedLagrangian
from mpmjax.state._fill import fill, fill_mapped
from mpmjax.state._material_points import MaterialPoints
from mpmjax.state._particles import Particles, State, by_material, history_arrays, join, state_of, with_state
from mpmjax.state._preparation import is_prepared, prepare
from mpmjax.state._scene import Scene

__all__ = [
    "AbstractBodyForce",
    "AbstractDescription",
    "MaterialPoints",
    "Particles",
    "Scene",
    "State",
    "TotalLagrangian",
    "UpdatedLagrangian",
    "by_material",
    "fill",
    "fill_mapped",
    "history_arrays",
    "is_prepared",
    "join",
    "prepare",
    "state_of",
    "with_state",
]
