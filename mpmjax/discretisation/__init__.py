"""Grid, B-spline kernels, stencils, and the transfers between particles and grid."""

from mpmjax.discretisation._fused_sums import (
    average as average,
    resist as resist,
    resist_sum as resist_sum,
    without_flat as without_flat,
)
from mpmjax.discretisation._grid import Grid as Grid
from mpmjax.discretisation._kernel import (
    AbstractGradient as AbstractGradient,
    BSpline as BSpline,
    MLSGradient as MLSGradient,
    SplineGradient as SplineGradient,
)
from mpmjax.discretisation._native_sums import basis_attributes as basis_attributes
from mpmjax.discretisation._stencil import (
    Basis as Basis,
    Stencil as Stencil,
    basis_of as basis_of,
    in_section as in_section,
    in_space as in_space,
    in_window as in_window,
    locate as locate,
    make_stencil as make_stencil,
)
from mpmjax.discretisation._sums import gather as gather, scatter as scatter
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
