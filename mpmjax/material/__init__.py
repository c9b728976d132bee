"""Laws: elastic, plastic, fluid, viscous."""

from mpmjax.material._base import AbstractIsotropic as AbstractIsotropic, AbstractMaterial as AbstractMaterial
from mpmjax.material._cam_clay import CamClay as CamClay, CamClayHistory as CamClayHistory
from mpmjax.material._drucker_prager import DruckerPrager as DruckerPrager, DruckerPragerHistory as DruckerPragerHistory
from mpmjax.material._elastic import FixedCorotated as FixedCorotated, NeoHookean as NeoHookean
from mpmjax.material._fluid import Fluid as Fluid
from mpmjax.material._hencky import Hencky as Hencky
from mpmjax.material._herschel_bulkley import (
    HerschelBulkley as HerschelBulkley,
    HerschelBulkleyHistory as HerschelBulkleyHistory,
)
from mpmjax.material._kinematics import (
    AbstractKinematics as AbstractKinematics,
    DeformationGradient as DeformationGradient,
    VolumeRatio as VolumeRatio,
)
from mpmjax.material._law import (
    AbstractElastic as AbstractElastic,
    AbstractInelastic as AbstractInelastic,
    AbstractLaw as AbstractLaw,
    Freedom as Freedom,
    Viscosity as Viscosity,
)
from mpmjax.material._rigid import Rigid as Rigid
from mpmjax.material._rubber import (
    AbstractRubber as AbstractRubber,
    Gent as Gent,
    MooneyRivlin as MooneyRivlin,
    Ogden as Ogden,
    Yeoh as Yeoh,
)
from mpmjax.material._snow import Snow as Snow, SnowElasticity as SnowElasticity, SnowHistory as SnowHistory
from mpmjax.material._tangent import (
    AbstractTangent as AbstractTangent,
    MatrixTangent as MatrixTangent,
    PrincipalTangent as PrincipalTangent,
    VolumetricTangent as VolumetricTangent,
)
from mpmjax.material._viscous import Viscous as Viscous
from mpmjax.material._volumetric import AbstractVolumetric as AbstractVolumetric
from mpmjax.material._von_mises import VonMises as VonMises, VonMisesHistory as VonMisesHistory
