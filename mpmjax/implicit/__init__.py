"""The elastic potential, its Hessian, and the nodal problems of the implicit updates and their solution.

Choices of a method: `ConjugateResidual`, `Linearised`, `Newton`; `AnalyticHessian`, `JvpHessian`;
`DiagonalPreconditioner`, `MassPreconditioner`; `Guess`. The bases to derive from are called `Abstract...`.
"""

from mpmjax.implicit._operator import (
    AbstractInnerProduct as AbstractInnerProduct,
    AbstractInnerProductSolver as AbstractInnerProductSolver,
    AbstractPreconditioner as AbstractPreconditioner,
    DiagonalInnerProduct as DiagonalInnerProduct,
    DiagonalPreconditioner as DiagonalPreconditioner,
    ImplicitOperator as ImplicitOperator,
    MassPreconditioner as MassPreconditioner,
    Projection as Projection,
    SolveInfo as SolveInfo,
    no_solve as no_solve,
    require_solver as require_solver,
)
from mpmjax.implicit._potential import (
    AbstractHessian as AbstractHessian,
    AbstractHessianAction as AbstractHessianAction,
    AnalyticHessian as AnalyticHessian,
    ElasticPotential as ElasticPotential,
    JvpHessian as JvpHessian,
    ParticleStiffness as ParticleStiffness,
    TangentAction as TangentAction,
)
from mpmjax.implicit._solver import ConjugateResidual as ConjugateResidual
from mpmjax.implicit._stage import (
    AbstractStageSolver as AbstractStageSolver,
    Guess as Guess,
    Linearised as Linearised,
    Newton as Newton,
    Reporting as Reporting,
    StageProblem as StageProblem,
    solve as solve,
    solve_linearised as solve_linearised,
)
