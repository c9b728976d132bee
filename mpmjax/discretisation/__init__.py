"""Grid, B-spline kernels, stencils, and the transfers between particles and grid."""

from mpmjax.discretisation._average import average
from mpmjax.discretisation._cell_order import Order, by_cell, cells_of, rearranged
from mpmjax.discretisation._gradient import AbstractGradient, MLSGradient, SplineGradient
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import BSpline
from mpmjax.discretisation._placed import bound, define_placed
from mpmjax.discretisation._resistance import resist
from mpmjax.discretisation._stencil import Places, Stencil, in_window, make_stencil
from mpmjax.discretisation._transfer import APIC, FLIP, PIC, AbstractTransfer, Gathered, g2p, p2g, without_empty
from mpmjax.discretisation._transfer_sums import gather, scatter

__all__ = [
    "APIC",
    "FLIP",
    "PIC",
    "AbstractGradient",
    "AbstractTransfer",
    "BSpline",
    "Gathered",
    "Grid",
    "MLSGradient",
    "Order",
    "Places",
    "SplineGradient",
    "Stencil",
    "average",
    "bound",
    "by_cell",
    "cells_of",
    "define_placed",
    "g2p",
    "gather",
    "in_window",
    "make_stencil",
    "p2g",
    "rearranged",
    "resist",
    "scatter",
    "without_empty",
]
