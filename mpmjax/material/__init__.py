"""Elastic laws."""

from mpmjax.material._base import (
    AbstractIsotropic,
    AbstractMaterial,
    AbstractTangent,
    MatrixTangent,
    PrincipalTangent,
)
from mpmjax.material._elastic import FixedCorotated, NeoHookean
from mpmjax.material._hencky import Hencky
from mpmjax.material._projection import projected_tangent

__all__ = [
    "AbstractIsotropic",
    "AbstractMaterial",
    "AbstractTangent",
    "FixedCorotated",
    "Hencky",
    "MatrixTangent",
    "NeoHookean",
    "PrincipalTangent",
    "projected_tangent",
]
