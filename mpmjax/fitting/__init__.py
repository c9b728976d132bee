"""Fitting parameters to measured data."""

from mpmjax.fitting._adam import Adam
from mpmjax.fitting._arrays import read_arrays
from mpmjax.fitting._bootstrap import Bootstrap, bootstrap
from mpmjax.fitting._columns import Columns, after, read_columns
from mpmjax.fitting._ensemble import EnsembleFit, fit_ensemble
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._field import Field
from mpmjax.fitting._fit import fit
from mpmjax.fitting._lbfgs import LBFGS
from mpmjax.fitting._levenberg_marquardt import LevenbergMarquardt
from mpmjax.fitting._multistart import LocalMinimum, MultistartFit, fit_multistart
from mpmjax.fitting._observation import AbstractObservation, Curve, Series, Tracks
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter, Bounded, Positive, Unbounded
from mpmjax.fitting._prediction import Prediction, predict, predict_observations
from mpmjax.fitting._prior import AbstractPrior, Gaussian, Smooth
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._profile import Profile, profile
from mpmjax.fitting._quantities import CentreOfMass, Density, Extent, Markers, StressStretch
from mpmjax.fitting._reaction import Force, Torque
from mpmjax.fitting._refined import RefinedFit, fit_refined
from mpmjax.fitting._result import Estimate, FitResult, NoiseEstimate
from mpmjax.fitting._staged import Stage, StagedFit, fit_staged

__all__ = [
    "LBFGS",
    "AbstractObservation",
    "AbstractOptimiser",
    "AbstractParameter",
    "AbstractPrior",
    "Adam",
    "Bootstrap",
    "Bounded",
    "CentreOfMass",
    "Columns",
    "Curve",
    "Density",
    "EnsembleFit",
    "Estimate",
    "Evaluation",
    "Experiment",
    "Extent",
    "Field",
    "FitProblem",
    "FitResult",
    "Force",
    "Gaussian",
    "LevenbergMarquardt",
    "LocalMinimum",
    "Markers",
    "MultistartFit",
    "NoiseEstimate",
    "Positive",
    "Prediction",
    "Profile",
    "RefinedFit",
    "Series",
    "Smooth",
    "Stage",
    "StagedFit",
    "StressStretch",
    "Torque",
    "Tracks",
    "Unbounded",
    "after",
    "bootstrap",
    "fit",
    "fit_ensemble",
    "fit_multistart",
    "fit_refined",
    "fit_staged",
    "predict",
    "predict_observations",
    "profile",
    "read_arrays",
    "read_columns",
]
