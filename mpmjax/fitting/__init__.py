"""Fitting parameters to measured data.

A first fit needs the names that `mpmjax` has itself: `fit`, `Experiment`, parameters and observations. Here are the
others: priors and fields, optimisers, strategies for hard fits, and uncertainty beyond standard errors.
"""

from mpmjax.fitting._columns import Columns as Columns, after as after, read_arrays as read_arrays, read_columns
from mpmjax.fitting._ensemble import Bootstrap, EnsembleFit, bootstrap, fit_ensemble
from mpmjax.fitting._experiment import Experiment as Experiment
from mpmjax.fitting._field import Field
from mpmjax.fitting._fit import fit as fit
from mpmjax.fitting._levenberg_marquardt import LevenbergMarquardt
from mpmjax.fitting._multistart import LocalMinimum, MultistartFit, fit_multistart
from mpmjax.fitting._observation import AbstractObservation, Curve as Curve
from mpmjax.fitting._optimiser import LBFGS, AbstractOptimiser, Adam, Evaluation
from mpmjax.fitting._parameter import (
    AbstractParameter,
    AbstractPrior,
    Bounded as Bounded,
    Gaussian,
    Positive as Positive,
    Smooth,
    Unbounded as Unbounded,
)
from mpmjax.fitting._prediction import Prediction, predict, predict_observations
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._profile import Profile, profile
from mpmjax.fitting._quantities import (
    CentreOfMass as CentreOfMass,
    Density,
    Extent as Extent,
    Markers as Markers,
    StressStretch as StressStretch,
)
from mpmjax.fitting._refined import RefinedFit, fit_refined
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult as FitResult, NoiseEstimate
from mpmjax.fitting._series import Force as Force, Series as Series, Torque, Tracks as Tracks
from mpmjax.fitting._staged import Stage, StagedFit, fit_staged

__all__ = [
    "LBFGS",
    "AbstractFit",
    "AbstractObservation",
    "AbstractOptimiser",
    "AbstractParameter",
    "AbstractPrior",
    "Adam",
    "Bootstrap",
    "Density",
    "EnsembleFit",
    "Estimate",
    "Evaluation",
    "Field",
    "FitProblem",
    "Gaussian",
    "LevenbergMarquardt",
    "LocalMinimum",
    "MultistartFit",
    "NoiseEstimate",
    "Prediction",
    "Profile",
    "RefinedFit",
    "Smooth",
    "Stage",
    "StagedFit",
    "Torque",
    "bootstrap",
    "fit_ensemble",
    "fit_multistart",
    "fit_refined",
    "fit_staged",
    "predict",
    "predict_observations",
    "profile",
    "read_columns",
]
