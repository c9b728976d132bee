"""Fitting parameters to measured data."""

from mpmjax.fitting._adam import Adam
from mpmjax.fitting._columns import read_columns
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._field import Field
from mpmjax.fitting._fit import fit
from mpmjax.fitting._lbfgs import LBFGS
from mpmjax.fitting._levenberg_marquardt import LevenbergMarquardt
from mpmjax.fitting._observation import AbstractObservation, Curve, Force, Series, Tracks
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter, Bounded, Positive, Unbounded
from mpmjax.fitting._prior import AbstractPrior, Gaussian, Smooth
from mpmjax.fitting._quantities import CentreOfMass, Density, Extent, Markers, StressStretch
from mpmjax.fitting._refined import RefinedFit, fit_refined
from mpmjax.fitting._result import Estimate, FitResult, NoiseEstimate

__all__ = [
    "LBFGS",
    "AbstractObservation",
    "AbstractOptimiser",
    "AbstractParameter",
    "AbstractPrior",
    "Adam",
    "Bounded",
    "CentreOfMass",
    "Curve",
    "Density",
    "Estimate",
    "Evaluation",
    "Experiment",
    "Extent",
    "Field",
    "FitResult",
    "Force",
    "Gaussian",
    "LevenbergMarquardt",
    "Markers",
    "NoiseEstimate",
    "Positive",
    "RefinedFit",
    "Series",
    "Smooth",
    "StressStretch",
    "Tracks",
    "Unbounded",
    "fit",
    "fit_refined",
    "read_columns",
]
