"""Problems with exact solutions and a check of laws, for tests, benchmarks and new laws. `mpmjax` does not import
it."""

from mpmjax.verification._check_law import check_law as check_law, tension as tension
from mpmjax.verification._exact_problem import (
    AbstractProblem as AbstractProblem,
    Column as Column,
    Ends as Ends,
    HenckyColumn as HenckyColumn,
    Manufactured as Manufactured,
    discretise as discretise,
    displacement_error as displacement_error,
    errors as errors,
    orders as orders,
    stress_error as stress_error,
)
from mpmjax.verification._motions import (
    AxisAligned as AxisAligned,
    BentBar as BentBar,
    ExpandingRing as ExpandingRing,
    StandingWave as StandingWave,
    TwoDisks as TwoDisks,
    VibratingBar as VibratingBar,
    Vortex as Vortex,
)
