"""Particles, scene and what a step needs of them."""

from mpmjax.state._attachment import (
    AbstractPlace as AbstractPlace,
    AttachedPoints as AttachedPoints,
    LoadedPoints as LoadedPoints,
    Patch as Patch,
    PointsAt as PointsAt,
)
from mpmjax.state._constraint import AbstractConstraint as AbstractConstraint, AbstractLayerImage as AbstractLayerImage
from mpmjax.state._fill import fill as fill, fill_mapped as fill_mapped
from mpmjax.state._loads import (
    AbstractBodyForce as AbstractBodyForce,
    AbstractLoad as AbstractLoad,
    Couple as Couple,
    PointLoad as PointLoad,
    Pressure as Pressure,
    Spring as Spring,
    Traction as Traction,
    load_force as load_force,
    points_of as points_of,
    terms_of as terms_of,
)
from mpmjax.state._material_points import (
    AveragedStiffness as AveragedStiffness,
    AveragedVolume as AveragedVolume,
    MaterialPoints as MaterialPoints,
    VolumeAverage as VolumeAverage,
)
from mpmjax.state._particles import (
    Particles as Particles,
    State as State,
    history_arrays as history_arrays,
    join as join,
    state_of as state_of,
    with_dust as with_dust,
    with_state as with_state,
)
from mpmjax.state._preparation import (
    attach as attach,
    is_foreign as is_foreign,
    is_prepared as is_prepared,
    prepare as prepare,
    velocity_gradient as velocity_gradient,
)
from mpmjax.state._scene import (
    AbstractCorrection as AbstractCorrection,
    AbstractDescription as AbstractDescription,
    Bodies as Bodies,
    Scene as Scene,
    TotalLagrangian as TotalLagrangian,
    UpdatedLagrangian as UpdatedLagrangian,
)
from mpmjax.state._setup_warnings import warn_of_crowding as warn_of_crowding, warn_of_rounding as warn_of_rounding
