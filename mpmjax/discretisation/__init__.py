"""Grid, B-spline kernels, stencils, and the transfers between particles and grid."""

from mpmjax.discretisation._average import average as average
from mpmjax.discretisation._grid import Grid as Grid
from mpmjax.discretisation._kernel import (
    AbstractGradient as AbstractGradient,
    BSpline as BSpline,
    MLSGradient as MLSGradient,
    SplineGradient as SplineGradient,
)
from mpmjax.discretisation._placed import bound as bound, define_placed as define_placed
from mpmjax.discretisation._resistance import resist as resist
from mpmjax.discretisation._stencil import (
    Places as Places,
    Stencil as Stencil,
    first_nodes as first_nodes,
    in_window as in_window,
    index_factors as index_factors,
    make_stencil as make_stencil,
)
from mpmjax.discretisation._transfer import (
    APIC as APIC,
    FLIP as FLIP,
    PIC as PIC,
    AbstractTransfer as AbstractTransfer,
    Gathered as Gathered,
    g2p as g2p,
    p2g as p2g,
    without_empty as without_empty,
)
from mpmjax.discretisation._transfer_sums import gather as gather, scatter as scatter
