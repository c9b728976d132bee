"""A differentiable Material Point Method in JAX, with explicit and implicit grid updates.

What a first scene and a first fit need is here. Solvers and preconditioners are in `mpm.implicit`, the rarer shapes in
`mpm.geometry`, quantities, priors and strategies of fits in `mpm.fitting`, small matrices for laws in `mpm.linalg`;
docs/features.md lists every name.
"""

import sys as _sys
from importlib import import_module as _import_module
from typing import TYPE_CHECKING

from mpmjax import (
    boundary as boundary,
    discretisation as discretisation,
    extensions as extensions,
    geometry as geometry,
    implicit as implicit,
    linalg as linalg,
    material as material,
    native as native,
    state as state,
    stepping as stepping,
)
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
from mpmjax.geometry import (
    Ball as Ball,
    Box as Box,
    HalfSpace as HalfSpace,
    Motion as Motion,
    RigidMotion as RigidMotion,
    TimeSeries as TimeSeries,
)
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

__version__ = "0.1.0"

_LATE = {
    "analysis": "budget energy momentum stress",
    "cli": "load_scene save_scene",
    "fitting": "Bounded Curve Experiment Positive Series Tracks Unbounded fit",
    "io": "load record register save table",
    "simulation": "Run SimulationError rollout simulate",
    "viz": "render",
}
"""The rooms that no step needs, and their names here. They load, with diffrax, optax and more, when first used."""

if TYPE_CHECKING:
    from mpmjax import (
        analysis as analysis,
        cli as cli,
        fitting as fitting,
        io as io,
        simulation as simulation,
        viz as viz,
    )
    from mpmjax.analysis import budget as budget, energy as energy, momentum as momentum, stress as stress
    from mpmjax.cli import load_scene as load_scene, save_scene as save_scene
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
    from mpmjax.io import load as load, record as record, register as register, save as save, table as table
    from mpmjax.simulation import (
        Run as Run,
        SimulationError as SimulationError,
        rollout as rollout,
        simulate as simulate,
    )
    from mpmjax.viz import render as render
else:

    def __getattr__(name: str):
        room = next((room for room, names in _LATE.items() if name in (room, *names.split())), None)
        if room is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = _import_module(f"{__name__}.{room}")
        globals()[name] = module if name == room else getattr(module, name)
        return globals()[name]

    def __dir__() -> list[str]:
        return sorted({*globals(), *_LATE, *" ".join(_LATE.values()).split()})

    if {"IPython", "marimo"} & _sys.modules.keys():  # notebooks show scenes, runs and fits by what this adds to them
        _import_module(f"{__name__}.viz")
