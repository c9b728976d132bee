"""Regions, distances sampled on a lattice, surfaces, prescribed motions and time series."""

from mpmjax._types import Corner as Corner
from mpmjax.geometry._cut_cells import Pieces as Pieces, inside_parts as inside_parts, surface_pieces as surface_pieces
from mpmjax.geometry._motion import (
    AbstractMotion as AbstractMotion,
    Changing as Changing,
    ChangingVector as ChangingVector,
    Motion as Motion,
    RigidMotion as RigidMotion,
    TimeSeries as TimeSeries,
    require_some as require_some,
    still as still,
    turn as turn,
    value_at as value_at,
    vector_size as vector_size,
)
from mpmjax.geometry._region import (
    AbstractRegion as AbstractRegion,
    Box as Box,
    Complement as Complement,
    HalfSpace as HalfSpace,
    Intersection as Intersection,
    Placed as Placed,
    Union as Union,
    box_cells as box_cells,
    check_corners as check_corners,
    length as length,
)
from mpmjax.geometry._rigid_body import (
    RigidBody as RigidBody,
    inertia as inertia,
    moment as moment,
    rigid_body as rigid_body,
    rotation_of as rotation_of,
    rotation_of_chords as rotation_of_chords,
    spinning as spinning,
)
from mpmjax.geometry._round import (
    Annulus as Annulus,
    Ball as Ball,
    Capsule as Capsule,
    Cylinder as Cylinder,
    Tube as Tube,
)
from mpmjax.geometry._sampled import (
    SampledDistance as SampledDistance,
    sample_distance as sample_distance,
    sample_mesh as sample_mesh,
)
