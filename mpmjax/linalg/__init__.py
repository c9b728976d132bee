"""Algebra of small matrices for laws, component first, (d, d, p).

Products, determinants, decompositions and functions of symmetric matrices. All of them except `symmetric_eigen` and
`principal_frame` can be differentiated to every order, at repeated stretches and eigenvalues too.
"""

from mpmjax.linalg._decompositions import (
    pairs as pairs,
    principal_frame as principal_frame,
    principal_modes as principal_modes,
    rotation as rotation,
    rotation_differential as rotation_differential,
    spin_compliance as spin_compliance,
    symmetric_eigen as symmetric_eigen,
)
from mpmjax.linalg._matrices import (
    assemble as assemble,
    cofactor as cofactor,
    cofactor_differential as cofactor_differential,
    determinant as determinant,
    diagonal as diagonal,
    double_dot as double_dot,
    entries as entries,
    finite as finite,
    identity_like as identity_like,
    matmul as matmul,
    matrix_of as matrix_of,
    symmetric as symmetric,
    trace as trace,
    transpose as transpose,
    upper_triangle as upper_triangle,
)
from mpmjax.linalg._spectral import (
    AbstractSpectral as AbstractSpectral,
    Logarithm as Logarithm,
    PowerBeyondLine as PowerBeyondLine,
    PowerLessOne as PowerLessOne,
    exponential_beyond_line as exponential_beyond_line,
)
