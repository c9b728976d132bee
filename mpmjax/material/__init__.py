"""Elastic laws."""

from mpmjax.material._base import AbstractMaterial, AbstractTangent, PrincipalTangent, lame_lambda, shear_modulus
from mpmjax.material._elastic import FixedCorotated, NeoHookean

__all__ = [
    "AbstractMaterial",
    "AbstractTangent",
    "FixedCorotated",
    "NeoHookean",
    "PrincipalTangent",
    "lame_lambda",
    "shear_modulus",
]
