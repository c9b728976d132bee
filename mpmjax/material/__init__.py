"""Elastic laws."""

from mpmjax.material._base import AbstractMaterial, AbstractTangent, PrincipalTangent, lame_lambda, shear_modulus
from mpmjax.material._elastic import FixedCorotated, NeoHookean
from mpmjax.material._projection import ProjectedTangent, projected_tangent

__all__ = [
    "AbstractMaterial",
    "AbstractTangent",
    "FixedCorotated",
    "NeoHookean",
    "PrincipalTangent",
    "ProjectedTangent",
    "lame_lambda",
    "projected_tangent",
    "shear_modulus",
]
