"""A differentiable Material Point Method in JAX, with explicit and implicit grid updates."""

from mpmjax._bench import Trial
from mpmjax._body_force import AbstractBodyForce
from mpmjax._boundary import AbstractBoundary, Conditions, Grip, SeparatingBox, SlipBox, StickyBox
from mpmjax._budget import Budget, EnergyBudget, MomentumBudget, budget
from mpmjax._collider import AbstractCollider, SeparatingCollider, SlipCollider, StickyCollider
from mpmjax._conjugate_residual import ConjugateResidual
from mpmjax._diagnostics import Energy, energy, momentum, pieces
from mpmjax._exchange import Exchange
from mpmjax._grid import Grid
from mpmjax._guess import Guess
from mpmjax._hessian import AnalyticHessian, JvpHessian
from mpmjax._implicit import Linearised
from mpmjax._io import load, save
from mpmjax._kernel import BSpline, MLSGradient, SplineGradient
from mpmjax._method import TRBDF2, BackwardEuler, Explicit, ImplicitMidpoint, SemiImplicit
from mpmjax._metric import Metric
from mpmjax._mirror import ContactPlane, SymmetryPlane
from mpmjax._motion import AbstractMotion, Motion, RigidMotion
from mpmjax._newton import Newton
from mpmjax._particles import Particles, join
from mpmjax._record import record
from mpmjax._region import AbstractRegion, Ball, Box, Capsule, Cylinder, HalfSpace, Union
from mpmjax._render import render
from mpmjax._run import Run, SimulationError
from mpmjax._sample import fill
from mpmjax._sampled import SampledDistance, sample_distance, sample_mesh
from mpmjax._scene import Scene, TotalLagrangian, UpdatedLagrangian, prepare
from mpmjax._sensitivity import Sensitivity, sensitivity
from mpmjax._simulate import rollout, simulate
from mpmjax._stability import stable_dt
from mpmjax._step import StepInfo, step
from mpmjax._transfer import APIC, FLIP, PIC
from mpmjax._work_precision import WorkPrecision, work_precision
from mpmjax.material import (
    AbstractMaterial,
    AbstractPlastic,
    AbstractTangent,
    CamClay,
    DruckerPrager,
    FixedCorotated,
    Fluid,
    Hencky,
    NeoHookean,
    Snow,
    Viscous,
    VonMises,
)

__version__ = "0.1.0"

__all__ = [  # noqa: RUF022 (grouped)
    # scene
    "Grid",
    "Scene",
    "UpdatedLagrangian",
    "TotalLagrangian",
    # particles and regions
    "Particles",
    "fill",
    "join",
    "prepare",
    "AbstractRegion",
    "Ball",
    "Box",
    "Capsule",
    "Cylinder",
    "HalfSpace",
    "SampledDistance",
    "Union",
    "sample_distance",
    "sample_mesh",
    # laws
    "AbstractMaterial",
    "AbstractPlastic",
    "AbstractTangent",
    "FixedCorotated",
    "Hencky",
    "NeoHookean",
    "Snow",
    "CamClay",
    "DruckerPrager",
    "VonMises",
    "Fluid",
    "Viscous",
    # discretisation
    "BSpline",
    "MLSGradient",
    "SplineGradient",
    "APIC",
    "FLIP",
    "PIC",
    # boundaries
    "AbstractBoundary",
    "AbstractMotion",
    "Conditions",
    "ContactPlane",
    "Grip",
    "Motion",
    "RigidMotion",
    "SeparatingBox",
    "SlipBox",
    "StickyBox",
    "SymmetryPlane",
    "AbstractCollider",
    "SeparatingCollider",
    "SlipCollider",
    "StickyCollider",
    "AbstractBodyForce",
    # grid updates
    "BackwardEuler",
    "Explicit",
    "ImplicitMidpoint",
    "SemiImplicit",
    "TRBDF2",
    "Linearised",
    "Newton",
    "AnalyticHessian",
    "JvpHessian",
    "ConjugateResidual",
    "Guess",
    "Metric",
    "stable_dt",
    # running
    "Run",
    "SimulationError",
    "StepInfo",
    "record",
    "rollout",
    "simulate",
    "step",
    "Trial",
    "WorkPrecision",
    "work_precision",
    # results
    "Budget",
    "EnergyBudget",
    "MomentumBudget",
    "budget",
    "Energy",
    "Exchange",
    "Sensitivity",
    "energy",
    "load",
    "momentum",
    "pieces",
    "render",
    "save",
    "sensitivity",
]
