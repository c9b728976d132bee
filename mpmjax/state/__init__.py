"""Particles, scene and what a step needs of them."""

from mpmjax.state._attachment import AbstractPlace, AttachedPoints, Patch, PointsAt
from mpmjax.state._averaged_volume import AveragedTangent, AveragedVolume, VolumeAverage
from mpmjax.state._bodies import Bodies
from mpmjax.state._body_force import AbstractBodyForce
from mpmjax.state._couple import Couple
from mpmjax.state._description import AbstractDescription, TotalLagrangian, UpdatedLagrangian
from mpmjax.state._fill import fill, fill_mapped
from mpmjax.state._loaded_points import LoadedPoints
from mpmjax.state._loads import AbstractLoad, PointLoad, Pressure, Spring, Traction, load_force, points_of, supports_of
from mpmjax.state._material_points import MaterialPoints
from mpmjax.state._order import (
    MemoryOrder,
    Rearrangement,
    attached_particles,
    given_order,
    places,
    rearrangement,
    whole_numbers,
)
from mpmjax.state._oversights import warn_of_crowding, warn_of_rounding
from mpmjax.state._particles import Particles, State, by_material, history_arrays, join, state_of, with_state
from mpmjax.state._preparation import is_prepared, prepare
from mpmjax.state._scene import RigidMaterial, Scene, attach
from mpmjax.state._support import Support, SupportStiffness, stiffness_of
from mpmjax.state._velocity_gradient import velocity_gradient

__all__ = [
    "AbstractBodyForce",
    "AbstractDescription",
    "AbstractLoad",
    "AbstractPlace",
    "AttachedPoints",
    "AveragedTangent",
    "AveragedVolume",
    "Bodies",
    "Couple",
    "LoadedPoints",
    "MaterialPoints",
    "MemoryOrder",
    "Particles",
    "Patch",
    "PointLoad",
    "PointsAt",
    "Pressure",
    "Rearrangement",
    "RigidMaterial",
    "Scene",
    "Spring",
    "State",
    "Support",
    "SupportStiffness",
    "TotalLagrangian",
    "Traction",
    "UpdatedLagrangian",
    "VolumeAverage",
    "attach",
    "attached_particles",
    "by_material",
    "fill",
    "fill_mapped",
    "given_order",
    "history_arrays",
    "is_prepared",
    "join",
    "load_force",
    "places",
    "points_of",
    "prepare",
    "rearrangement",
    "state_of",
    "stiffness_of",
    "supports_of",
    "velocity_gradient",
    "warn_of_crowding",
    "warn_of_rounding",
    "whole_numbers",
    "with_state",
]
