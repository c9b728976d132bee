"""Fitting parameters to measured data."""

from mpmjax.fitting._columns import read_columns
from mpmjax.fitting._fit import FitResult, fit_curve, gauge

__all__ = ["FitResult", "fit_curve", "gauge", "read_columns"]
