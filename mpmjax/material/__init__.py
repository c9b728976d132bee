"""Laws: elastic, plastic, fluid, viscous."""

from mpmjax.material._base import AbstractIsotropic, AbstractMaterial
from mpmjax.material._cam_clay import CamClay, CamClayHistory
from mpmjax.material._drucker_prager import DruckerPrager, DruckerPragerHistory
from mpmjax.material._elastic import FixedCorotated, NeoHookean
from mpmjax.material._fluid import Fluid, Tait
from mpmjax.material._freedom import Freedom
from mpmjax.material._hencky import Hencky
from mpmjax.material._herschel_bulkley import HerschelBulkley, HerschelBulkleyHistory
from mpmjax.material._kinematics import AbstractKinematics, DeformationGradient, VolumeRatio
from mpmjax.material._law import AbstractElastic, AbstractInelastic, AbstractLaw
from mpmjax.material._rigid import Rigid
from mpmjax.material._rubber import AbstractRubber, Gent, MooneyRivlin, Ogden, Yeoh
from mpmjax.material._snow import Snow, SnowElasticity, SnowHistory
from mpmjax.material._tangent import AbstractTangent, MatrixTangent, PrincipalTangent, VolumetricTangent
from mpmjax.material._viscosity import Viscosity
from mpmjax.material._viscous import Viscous
from mpmjax.material._volumetric import AbstractVolumetric
from mpmjax.material._von_mises import VonMises, VonMisesHistory

__all__ = [
    "AbstractElastic",
    "AbstractInelastic",
    "AbstractIsotropic",
    "AbstractKinematics",
    "AbstractLaw",
    "AbstractMaterial",
    "AbstractRubber",
    "AbstractTangent",
    "AbstractVolumetric",
    "CamClay",
    "CamClayHistory",
    "DeformationGradient",
    "DruckerPrager",
    "DruckerPragerHistory",
    "FixedCorotated",
    "Fluid",
    "Freedom",
    "Gent",
    "Hencky",
    "HerschelBulkley",
    "HerschelBulkleyHistory",
    "MatrixTangent",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "PrincipalTangent",
    "Rigid",
    "Snow",
    "SnowElasticity",
    "SnowHistory",
    "Tait",
    "Viscosity",
    "Viscous",
    "VolumeRatio",
    "VolumetricTangent",
    "VonMises",
    "VonMisesHistory",
    "Yeoh",
]
