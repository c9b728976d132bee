"""A differentiable Material Point Method in JAX, with explicit and implicit grid updates."""

from mpmjax import fitting as fitting, linalg as linalg
from mpmjax._types import Corner as Corner
from mpmjax.analysis import (
    budget as budget,
    energy as energy,
    momentum as momentum,
    sensitivity as sensitivity,
)
from mpmjax.boundary import (
    ContactPlane as ContactPlane,
    Grip as Grip,
    RigidPart as RigidPart,
    SeparatingBox as SeparatingBox,
    SeparatingCollider as SeparatingCollider,
    SlipBox as SlipBox,
    SlipCollider as SlipCollider,
    StickyBox as StickyBox,
    StickyCollider as StickyCollider,
    SymmetryPlane as SymmetryPlane,
)
from mpmjax.discretisation import (
    APIC as APIC,
    FLIP as FLIP,
    PIC as PIC,
    BSpline as BSpline,
    Grid as Grid,
    MLSGradient as MLSGradient,
    SplineGradient as SplineGradient,
)
from mpmjax.extensions import VolumePreconditioner as VolumePreconditioner
from mpmjax.fitting import (
    Bounded as Bounded,
    CentreOfMass as CentreOfMass,
    Curve as Curve,
    Experiment as Experiment,
    Extent as Extent,
    FitResult as FitResult,
    Force as Force,
    Markers as Markers,
    Positive as Positive,
    Series as Series,
    StressStretch as StressStretch,
    Tracks as Tracks,
    Unbounded as Unbounded,
    fit as fit,
)
from mpmjax.geometry import (
    Annulus as Annulus,
    Ball as Ball,
    Box as Box,
    Capsule as Capsule,
    Cylinder as Cylinder,
    HalfSpace as HalfSpace,
    Motion as Motion,
    RigidMotion as RigidMotion,
    SampledDistance as SampledDistance,
    TimeSeries as TimeSeries,
    Tube as Tube,
    Union as Union,
    sample_distance as sample_distance,
    sample_mesh as sample_mesh,
)
from mpmjax.implicit import (
    AnalyticHessian as AnalyticHessian,
    ConjugateResidual as ConjugateResidual,
    DiagonalPreconditioner as DiagonalPreconditioner,
    Guess as Guess,
    JvpHessian as JvpHessian,
    Linearised as Linearised,
    MassPreconditioner as MassPreconditioner,
    Newton as Newton,
)
from mpmjax.io import load as load, record as record, register as register, save as save
from mpmjax.material import (
    AbstractInelastic as AbstractInelastic,
    AbstractMaterial as AbstractMaterial,
    CamClay as CamClay,
    DruckerPrager as DruckerPrager,
    FixedCorotated as FixedCorotated,
    Fluid as Fluid,
    Gent as Gent,
    Hencky as Hencky,
    HerschelBulkley as HerschelBulkley,
    MooneyRivlin as MooneyRivlin,
    NeoHookean as NeoHookean,
    Ogden as Ogden,
    Rigid as Rigid,
    Snow as Snow,
    Viscous as Viscous,
    VonMises as VonMises,
    Yeoh as Yeoh,
)
from mpmjax.native import backend as backend
from mpmjax.simulation import (
    Fault as Fault,
    Run as Run,
    SimulationError as SimulationError,
    rollout as rollout,
    simulate as simulate,
)
from mpmjax.state import (
    AttachedPoints as AttachedPoints,
    AveragedVolume as AveragedVolume,
    Bodies as Bodies,
    Couple as Couple,
    Particles as Particles,
    Patch as Patch,
    PointLoad as PointLoad,
    PointsAt as PointsAt,
    Pressure as Pressure,
    Scene as Scene,
    Spring as Spring,
    TotalLagrangian as TotalLagrangian,
    Traction as Traction,
    UpdatedLagrangian as UpdatedLagrangian,
    attach as attach,
    fill as fill,
    fill_mapped as fill_mapped,
    join as join,
    prepare as prepare,
)
from mpmjax.stepping import (
    TRBDF2 as TRBDF2,
    BackwardEuler as BackwardEuler,
    Explicit as Explicit,
    ImplicitMidpoint as ImplicitMidpoint,
    SemiImplicit as SemiImplicit,
    stable_dt as stable_dt,
    step as step,
)
from mpmjax.viz import render as render

__version__ = "0.1.0"
