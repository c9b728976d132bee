"""Laws."""

from mpmjax.material._base import (
    AbstractIsotropic,
    AbstractMaterial,
    AbstractPlastic,
    AbstractTangent,
    AbstractVolumetric,
    Law,
    MatrixTangent,
    PrincipalTangent,
)
from mpmjax.material._cam_clay import CamClay
from mpmjax.material._drucker_prager import DruckerPrager
from mpmjax.material._elastic import FixedCorotated, NeoHookean
from mpmjax.material._fluid import Fluid, NoHistory, Tait
from mpmjax.material._hencky import Hencky
from mpmjax.material._projection import projected_tangent
from mpmjax.material._snow import Snow, SnowHistory
from mpmjax.material._viscous import Viscosity, Viscous
from mpmjax.material._von_mises import VonMises

__all__ = [
    "AbstractIsotropic",
    "AbstractMaterial",
    "AbstractPlastic",
    "AbstractTangent",
    "AbstractVolumetric",
    "CamClay",
    "DruckerPrager",
    "FixedCorotated",
    "Fluid",
    "Hencky",
    "Law",
    "MatrixTangent",
    "NeoHookean",
    "NoHistory",
    "PrincipalTangent",
    "Snow",
    "SnowHistory",
    "Tait",
    "Viscosity",
    "Viscous",
    "VonMises",
    "projected_tangent",
]
