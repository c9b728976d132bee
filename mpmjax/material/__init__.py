"""Laws: elastic, plastic, fluid, viscous."""

from mpmjax.material._base import (
    AbstractInelastic,
    AbstractIsotropic,
    AbstractMaterial,
    AbstractTangent,
    AbstractVolumetric,
    Law,
    MatrixTangent,
    PrincipalTangent,
)
from mpmjax.material._cam_clay import CamClay, CamClayHistory
from mpmjax.material._drucker_prager import DruckerPrager, DruckerPragerHistory
from mpmjax.material._elastic import FixedCorotated, NeoHookean
from mpmjax.material._fluid import Fluid, NoHistory, Tait
from mpmjax.material._hencky import Hencky
from mpmjax.material._projection import projected_tangent
from mpmjax.material._snow import Snow, SnowElasticity, SnowHistory
from mpmjax.material._viscous import Viscosity, Viscous
from mpmjax.material._von_mises import VonMises, VonMisesHistory

__all__ = [
    "AbstractInelastic",
    "AbstractIsotropic",
    "AbstractMaterial",
    "AbstractTangent",
    "AbstractVolumetric",
    "CamClay",
    "CamClayHistory",
    "DruckerPrager",
    "DruckerPragerHistory",
    "FixedCorotated",
    "Fluid",
    "Hencky",
    "Law",
    "MatrixTangent",
    "NeoHookean",
    "NoHistory",
    "PrincipalTangent",
    "Snow",
    "SnowElasticity",
    "SnowHistory",
    "Tait",
    "Viscosity",
    "Viscous",
    "VonMises",
    "VonMisesHistory",
    "projected_tangent",
]
