"""Regions, distances sampled on a lattice, prescribed motions."""

from mpmjax.geometry._cells import box_cells
from mpmjax.geometry._hollow import Annulus, Tube
from mpmjax.geometry._motion import AbstractMotion, Motion, RigidMotion, still
from mpmjax.geometry._parts import inside_parts
from mpmjax.geometry._region import AbstractRegion, Ball, Box, Capsule, Cylinder, HalfSpace, Union, length
from mpmjax.geometry._sampled import SampledDistance, sample_distance, sample_mesh

__all__ = [
    "AbstractMotion",
    "AbstractRegion",
    "Annulus",
    "Ball",
    "Box",
    "Capsule",
    "Cylinder",
    "HalfSpace",
    "Motion",
    "RigidMotion",
    "SampledDistance",
    "Tube",
    "Union",
    "box_cells",
    "inside_parts",
    "length",
    "sample_distance",
    "sample_mesh",
    "still",
]
