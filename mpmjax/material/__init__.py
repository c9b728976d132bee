"""Elastic laws."""

from mpmjax.material._base import AbstractMaterial, AbstractTangent, lame_lambda, shear_modulus
from mpmjax.material._elastic import FixedCorotated, NeoHookean

__all__ = ["AbstractMaterial", "AbstractTangent", "FixedCorotated", "NeoHookean", "lame_lambda", "shear_modulus"]
