"""Problems with exact solutions and a check of laws, for tests, benchmarks and new laws. `mpmjax` does not import
it."""

from mpmjax.verification._aligned import AxisAligned
from mpmjax.verification._bar import VibratingBar
from mpmjax.verification._column import Column, HenckyColumn
from mpmjax.verification._disks import TwoDisks
from mpmjax.verification._law import check_law
from mpmjax.verification._problem import (
    AbstractProblem,
    Ends,
    Manufactured,
    discretise,
    displacement_error,
    stress_error,
)
from mpmjax.verification._refinement import errors, orders
from mpmjax.verification._ring import ExpandingRing
from mpmjax.verification._tension import tension
from mpmjax.verification._vortex import Vortex
from mpmjax.verification._wave import StandingWave

__all__ = [
    "AbstractProblem",
    "AxisAligned",
    "Column",
    "Ends",
    "ExpandingRing",
    "HenckyColumn",
    "Manufactured",
    "StandingWave",
    "TwoDisks",
    "VibratingBar",
    "Vortex",
    "check_law",
    "discretise",
    "displacement_error",
    "errors",
    "orders",
    "stress_error",
    "tension",
]
