"""The elastic potential, its Hessian, and the nodal problems of the implicit updates and their solution."""

from mpmjax.implicit._conjugate_residual import ConjugateResidual
from mpmjax.implicit._hessian import (
    AbstractHessian,
    AbstractHessianAction,
    AnalyticHessian,
    JvpHessian,
    ParticleStiffness,
    TangentAction,
    damped,
)
from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._linear_solve import AbstractInnerProductSolver, require_solver
from mpmjax.implicit._newton import Newton
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._preconditioner import AbstractPreconditioner, DiagonalPreconditioner, MassPreconditioner
from mpmjax.implicit._projection import Projection
from mpmjax.implicit._solution import AbstractSolution, Linearised, SolveInfo, exact_force, no_solve
from mpmjax.implicit._solve import Reporting, solve
from mpmjax.implicit._stage_problem import Guess, StageProblem
from mpmjax.implicit._volume_preconditioner import VolumePreconditioner

__all__ = [
    "AbstractHessian",
    "AbstractHessianAction",
    "AbstractInnerProduct",
    "AbstractInnerProductSolver",
    "AbstractPreconditioner",
    "AbstractSolution",
    "AnalyticHessian",
    "ConjugateResidual",
    "DiagonalInnerProduct",
    "DiagonalPreconditioner",
    "ElasticPotential",
    "Guess",
    "ImplicitOperator",
    "JvpHessian",
    "Linearised",
    "MassPreconditioner",
    "Newton",
    "ParticleStiffness",
    "Projection",
    "Reporting",
    "SolveInfo",
    "StageProblem",
    "TangentAction",
    "VolumePreconditioner",
    "damped",
    "exact_force",
    "no_solve",
    "require_solver",
    "solve",
]
