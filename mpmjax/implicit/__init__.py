"""The elastic potential, its Hessian, and the nodal problems of the implicit updates and their solution."""

from mpmjax.implicit._conjugate_residual import ConjugateResidual as ConjugateResidual
from mpmjax.implicit._hessian import (
    AbstractHessian as AbstractHessian,
    AbstractHessianAction as AbstractHessianAction,
    AnalyticHessian as AnalyticHessian,
    JvpHessian as JvpHessian,
    ParticleStiffness as ParticleStiffness,
    TangentAction as TangentAction,
    damped as damped,
)
from mpmjax.implicit._inner_product import (
    AbstractInnerProduct as AbstractInnerProduct,
    DiagonalInnerProduct as DiagonalInnerProduct,
)
from mpmjax.implicit._linear_solve import (
    AbstractInnerProductSolver as AbstractInnerProductSolver,
    require_solver as require_solver,
)
from mpmjax.implicit._newton import Newton as Newton
from mpmjax.implicit._operator import ImplicitOperator as ImplicitOperator
from mpmjax.implicit._potential import ElasticPotential as ElasticPotential
from mpmjax.implicit._preconditioner import (
    AbstractPreconditioner as AbstractPreconditioner,
    DiagonalPreconditioner as DiagonalPreconditioner,
    MassPreconditioner as MassPreconditioner,
)
from mpmjax.implicit._projection import Projection as Projection
from mpmjax.implicit._solution import (
    AbstractSolution as AbstractSolution,
    Linearised as Linearised,
    SolveInfo as SolveInfo,
    exact_force as exact_force,
    no_solve as no_solve,
)
from mpmjax.implicit._solve import Reporting as Reporting, solve as solve
from mpmjax.implicit._stage_problem import Guess as Guess, StageProblem as StageProblem
from mpmjax.implicit._volume_preconditioner import VolumePreconditioner as VolumePreconditioner
