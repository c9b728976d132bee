"""The package's own classes that files can hold."""

from mpmjax.boundary import (
    ContactPlane,
    Grip,
    RigidPart,
    SeparatingBox,
    SeparatingCollider,
    SlipBox,
    SlipCollider,
    StickyBox,
    StickyCollider,
    SymmetryPlane,
)
from mpmjax.discretisation import APIC, FLIP, PIC, BSpline, Grid, MLSGradient, SplineGradient
from mpmjax.geometry import (
    Annulus,
    Ball,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Motion,
    RigidMotion,
    SampledDistance,
    TimeSeries,
    Tube,
    Union,
)
from mpmjax.implicit import (
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    JvpHessian,
    Linearised,
    MassPreconditioner,
    Newton,
    VolumePreconditioner,
)
from mpmjax.material import (
    CamClay,
    DruckerPrager,
    FixedCorotated,
    Fluid,
    Gent,
    Hencky,
    HerschelBulkley,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Rigid,
    Snow,
    Viscous,
    VonMises,
    Yeoh,
)
from mpmjax.state import (
    AttachedPoints,
    AveragedVolume,
    Bodies,
    Couple,
    Patch,
    PointLoad,
    PointsAt,
    Pressure,
    Scene,
    Spring,
    TotalLagrangian,
    Traction,
    UpdatedLagrangian,
)
from mpmjax.stepping import TRBDF2, BackwardEuler, Explicit, ImplicitMidpoint, SemiImplicit

CLASSES: tuple[type, ...] = (
    Scene,
    Grid,
    *(FixedCorotated, NeoHookean, Hencky),
    *(MooneyRivlin, Yeoh, Gent, Ogden),
    *(Snow, VonMises, HerschelBulkley, DruckerPrager, CamClay, Fluid, Viscous, Rigid),
    *(StickyBox, SlipBox, SeparatingBox, Grip, SymmetryPlane, ContactPlane, RigidPart),
    *(StickyCollider, SlipCollider, SeparatingCollider),
    *(Box, Ball, HalfSpace, Capsule, Cylinder, Annulus, Tube, Union, SampledDistance, Motion, RigidMotion),
    *(Traction, Pressure, PointLoad, Couple, Spring, Patch, PointsAt, AttachedPoints, TimeSeries),
    Bodies,
    *(BSpline, SplineGradient, MLSGradient, PIC, FLIP, APIC, UpdatedLagrangian, TotalLagrangian),
    AveragedVolume,
    *(Explicit, SemiImplicit, BackwardEuler, ImplicitMidpoint, TRBDF2),
    *(Linearised, Newton, AnalyticHessian, JvpHessian, ConjugateResidual),
    *(DiagonalPreconditioner, MassPreconditioner, VolumePreconditioner),
)
"""The package's own classes that files can hold."""
