"""The public names, and the room that each is from: for type checkers, and for `__init__.py`, which loads them."""

from mpmjax import (
    analysis as analysis,
    boundary as boundary,
    cli as cli,
    discretisation as discretisation,
    extensions as extensions,
    fitting as fitting,
    geometry as geometry,
    implicit as implicit,
    io as io,
    linalg as linalg,
    material as material,
    native as native,
    simulation as simulation,
    state as state,
    stepping as stepping,
    viz as viz,
)
from mpmjax.analysis import budget as budget, energy as energy, momentum as momentum, stress as stress
from mpmjax.boundary import (
    ClampPlane as ClampPlane,
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
from mpmjax.cli import load_scene as load_scene, save_scene as save_scene
from mpmjax.discretisation import (
    APIC as APIC,
    FLIP as FLIP,
    PIC as PIC,
    BSpline as BSpline,
    Grid as Grid,
    MLSGradient as MLSGradient,
    SplineGradient as SplineGradient,
)
from mpmjax.extensions import Rigid as Rigid
from mpmjax.fitting import (
    Bounded as Bounded,
    Curve as Curve,
    Experiment as Experiment,
    Positive as Positive,
    Series as Series,
    Tracks as Tracks,
    Unbounded as Unbounded,
    fit as fit,
)
from mpmjax.geometry import (
    Ball as Ball,
    Box as Box,
    HalfSpace as HalfSpace,
    Motion as Motion,
    RigidMotion as RigidMotion,
    TimeSeries as TimeSeries,
)
from mpmjax.io import load as load, record as record, register as register, save as save, table as table
from mpmjax.material import (
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
    Snow as Snow,
    Viscous as Viscous,
    VonMises as VonMises,
    Yeoh as Yeoh,
)
from mpmjax.simulation import (
    Run as Run,
    SimulationError as SimulationError,
    rollout as rollout,
    simulate as simulate,
)
from mpmjax.state import (
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

__version__: str
