"""Regions, distances sampled on a lattice, surfaces, prescribed motions and time series."""

from mpmjax.geometry._cells import box_cells
from mpmjax.geometry._hollow import Annulus, Tube
from mpmjax.geometry._motion import AbstractMotion, Motion, RigidMotion, still, turn
from mpmjax.geometry._parts import inside_parts
from mpmjax.geometry._region import AbstractRegion, Ball, Box, Capsule, Cylinder, HalfSpace, Union, length
from mpmjax.geometry._rigid_body import (
    RigidBody,
    inertia,
    moment,
    rigid_body,
    rotation_of,
    rotation_of_chords,
    spinning,
)
from mpmjax.geometry._sampled import SampledDistance, sample_distance, sample_mesh
from mpmjax.geometry._surface import Pieces, surface_pieces
from mpmjax.geometry._time_series import Changing, ChangingVector, TimeSeries, require_some, value_at, vector_size

__all__ = [
    "AbstractMotion",
    "AbstractRegion",
    "Annulus",
    "Ball",
    "Box",
    "Capsule",
    "Changing",
    "ChangingVector",
    "Cylinder",
    "HalfSpace",
    "Motion",
    "Pieces",
    "RigidBody",
    "RigidMotion",
    "SampledDistance",
    "TimeSeries",
    "Tube",
    "Union",
    "box_cells",
    "inertia",
    "inside_parts",
    "length",
    "moment",
    "require_some",
    "rigid_body",
    "rotation_of",
    "rotation_of_chords",
    "sample_distance",
    "sample_mesh",
    "spinning",
    "still",
    "surface_pieces",
    "turn",
    "value_at",
    "vector_size",
]
