"""Which optimiser a fit takes if it is given none."""

from mpmjax.fitting._lbfgs import LBFGS
from mpmjax.fitting._levenberg_marquardt import LevenbergMarquardt
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._problem import ROW_COST, FitProblem


def chosen_optimiser(problem: FitProblem) -> AbstractOptimiser:
    """Levenberg-Marquardt while its Jacobian is cheap: by forward mode it costs as much as a simulation for each few
    parameters, by reverse mode for each measured number. Else L-BFGS, whose gradient costs the same for any number of
    parameters, and which takes more iterations (docs/fitting.md has the measurement)."""
    columns = min(problem.size, ROW_COST * problem.measured)
    return LevenbergMarquardt() if columns <= MOST_COLUMNS else LBFGS()


MOST_COLUMNS = 32
"""Columns of a Jacobian, or rows at what they cost more, up to which Levenberg-Marquardt is the cheaper."""
