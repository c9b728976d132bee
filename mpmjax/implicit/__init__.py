"""The elastic potential, its Hessian, and the nodal problems of the implicit updates and their solution."""

from mpmjax.implicit._conjugate_residual import ConjugateResidual, Reporting
from mpmjax.implicit._guess import Guess
from mpmjax.implicit._hessian import AnalyticHessian, Hessian, JvpHessian, damped
from mpmjax.implicit._implicit import Linearised, solve
from mpmjax.implicit._metric import Metric
from mpmjax.implicit._newton import Newton
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._problems import LinearProblem, NewtonProblem, SolveInfo, no_solve
from mpmjax.implicit._projection import Projection

__all__ = [
    "AnalyticHessian",
    "ConjugateResidual",
    "ElasticPotential",
    "Guess",
    "Hessian",
    "JvpHessian",
    "LinearProblem",
    "Linearised",
    "Metric",
    "Newton",
    "NewtonProblem",
    "Projection",
    "Reporting",
    "SolveInfo",
    "damped",
    "no_solve",
    "solve",
]
