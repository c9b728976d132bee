"""Regions, distances sampled on a lattice, prescribed motions."""

from mpmjax.geometry._motion import AbstractMotion, Motion, RigidMotion, still
from mpmjax.geometry._region import AbstractRegion, Ball, Box, Capsule, Cylinder, HalfSpace, Union, length
from mpmjax.geometry._sampled import SampledDistance, sample_distance, sample_mesh

__all__ = [
    "AbstractMotion",
    "AbstractRegion",
    "Ball",
    "Box",
    "Capsule",
    "Cylinder",
    "HalfSpace",
    "Motion",
    "RigidMotion",
    "SampledDistance",
    "Union",
    "length",
    "sample_distance",
    "sample_mesh",
    "still",
]
