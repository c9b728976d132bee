"""Laws: elastic, plastic, fluid, viscous."""

from mpmjax.material._base import AbstractIsotropic as AbstractIsotropic, AbstractMaterial as AbstractMaterial
from mpmjax.material._elastic import FixedCorotated as FixedCorotated, NeoHookean as NeoHookean
from mpmjax.material._fluid import AbstractVolumetric as AbstractVolumetric, Fluid as Fluid
from mpmjax.material._granular import (
    CamClay as CamClay,
    CamClayHistory as CamClayHistory,
    DruckerPrager as DruckerPrager,
    DruckerPragerHistory as DruckerPragerHistory,
    Snow as Snow,
    SnowElasticity as SnowElasticity,
    SnowHistory as SnowHistory,
)
from mpmjax.material._hencky import AbstractHenckyPlasticity as AbstractHenckyPlasticity, Hencky as Hencky
from mpmjax.material._law import (
    AbstractDeformationMeasure as AbstractDeformationMeasure,
    AbstractElastic as AbstractElastic,
    AbstractInelastic as AbstractInelastic,
    AbstractLaw as AbstractLaw,
    DeformationGradient as DeformationGradient,
    Freedom as Freedom,
    Viscosity as Viscosity,
    VolumeRatio as VolumeRatio,
)
from mpmjax.material._rigid import Rigid as Rigid
from mpmjax.material._rubber import (
    AbstractRubber as AbstractRubber,
    Gent as Gent,
    MooneyRivlin as MooneyRivlin,
    Ogden as Ogden,
    Yeoh as Yeoh,
)
from mpmjax.material._tangent import (
    AbstractTangent as AbstractTangent,
    MatrixTangent as MatrixTangent,
    PrincipalTangent as PrincipalTangent,
    VolumetricTangent as VolumetricTangent,
)
from mpmjax.material._viscous import Viscous as Viscous
from mpmjax.material._von_mises import (
    HerschelBulkley as HerschelBulkley,
    HerschelBulkleyHistory as HerschelBulkleyHistory,
    VonMises as VonMises,
    VonMisesHistory as VonMisesHistory,
)
