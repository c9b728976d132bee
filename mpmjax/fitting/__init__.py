"""Fitting parameters to measured data.

A first fit begins with names of `mpmjax` itself: `fit`, `Experiment`, `Positive`, `Bounded`, `Unbounded`, `Tracks`,
`Series`, `Curve`. Here are the quantities that a series measures, forces and torques, priors and fields, optimisers,
strategies for hard fits, and uncertainty beyond standard errors.
"""

from mpmjax.fitting._columns import (
    Columns as Columns,
    after as after,
    read_arrays as read_arrays,
    read_columns as read_columns,
    stated_unit as stated_unit,
)
from mpmjax.fitting._estimate import AbstractFit as AbstractFit, Estimate as Estimate, NoiseEstimate as NoiseEstimate
from mpmjax.fitting._evaluation import Evaluation as Evaluation
from mpmjax.fitting._experiment import (
    AbstractObservation as AbstractObservation,
    Experiment as Experiment,
    Shown as Shown,
)
from mpmjax.fitting._fit import EnsembleFit as EnsembleFit, fit as fit, fit_ensemble as fit_ensemble
from mpmjax.fitting._observation import (
    CentreOfMass as CentreOfMass,
    Curve as Curve,
    Density as Density,
    Extent as Extent,
    Force as Force,
    Markers as Markers,
    Series as Series,
    StressStretch as StressStretch,
    Torque as Torque,
    Tracks as Tracks,
)
from mpmjax.fitting._optimiser import LBFGS as LBFGS, Adam as Adam, LevenbergMarquardt as LevenbergMarquardt
from mpmjax.fitting._parameter import (
    AbstractParameter as AbstractParameter,
    AbstractPrior as AbstractPrior,
    Bounded as Bounded,
    Field as Field,
    Gaussian as Gaussian,
    Positive as Positive,
    Smooth as Smooth,
    Unbounded as Unbounded,
)
from mpmjax.fitting._prediction import (
    Bootstrap as Bootstrap,
    bootstrap as bootstrap,
    predict as predict,
    predict_observations as predict_observations,
)
from mpmjax.fitting._problem import FitProblem as FitProblem
from mpmjax.fitting._profile import Profile as Profile, profile as profile
from mpmjax.fitting._result import FitResult as FitResult
from mpmjax.fitting._search import AbstractOptimiser as AbstractOptimiser
from mpmjax.fitting._sequence import RefinedFit as RefinedFit, fit_refined as fit_refined, fit_staged as fit_staged
from mpmjax.fitting._starts import Screening as Screening, Starts as Starts
from mpmjax.fitting._uncertainty import Prediction as Prediction
