"""Algebra of small matrices for laws, component first, (d, d, p).

Products, determinants, decompositions and functions of symmetric matrices. All of them except `symmetric_eigen` and
`principal_frame` can be differentiated to every order, at repeated stretches and eigenvalues too.
"""

from mpmjax.linalg._finite import finite
from mpmjax.linalg._matrices import (
    assemble,
    cofactor,
    cofactor_differential,
    determinant,
    diagonal,
    double_dot,
    entries,
    identity_like,
    matmul,
    matrix_of,
    symmetric,
    trace,
    transpose,
    upper_triangle,
)
from mpmjax.linalg._principal import pairs, principal_frame, principal_modes, symmetric_eigen
from mpmjax.linalg._rotation import rotation, rotation_differential, spin_compliance
from mpmjax.linalg._spectral import AbstractSpectral, Logarithm, PowerLessOne

__all__ = [
    "AbstractSpectral",
    "Logarithm",
    "PowerLessOne",
    "assemble",
    "cofactor",
    "cofactor_differential",
    "determinant",
    "diagonal",
    "double_dot",
    "entries",
    "finite",
    "identity_like",
    "matmul",
    "matrix_of",
    "pairs",
    "principal_frame",
    "principal_modes",
    "rotation",
    "rotation_differential",
    "spin_compliance",
    "symmetric",
    "symmetric_eigen",
    "trace",
    "transpose",
    "upper_triangle",
]
