"""Laws: elastic, plastic, fluid, viscous."""

from mpmjax.material._differential import (
    AbstractDifferential as AbstractDifferential,
    MatrixDifferential as MatrixDifferential,
    PrincipalDifferential as PrincipalDifferential,
    VolumetricDifferential as VolumetricDifferential,
)
from mpmjax.material._elastic import (
    AbstractIsotropic as AbstractIsotropic,
    FixedCorotated as FixedCorotated,
    NeoHookean as NeoHookean,
)
from mpmjax.material._fluid import AbstractVolumetric as AbstractVolumetric, Fluid as Fluid, Viscous as Viscous
from mpmjax.material._granular import (
    CamClay as CamClay,
    CamClayHistory as CamClayHistory,
    DruckerPrager as DruckerPrager,
    DruckerPragerHistory as DruckerPragerHistory,
    Snow as Snow,
    SnowElasticity as SnowElasticity,
    SnowHistory as SnowHistory,
)
from mpmjax.material._hencky import (
    AbstractHenckyPlasticity as AbstractHenckyPlasticity,
    Hencky as Hencky,
    HerschelBulkley as HerschelBulkley,
    VonMises as VonMises,
    VonMisesHistory as VonMisesHistory,
)
from mpmjax.material._law import (
    AbstractInelastic as AbstractInelastic,
    AbstractLaw as AbstractLaw,
    AbstractMaterial as AbstractMaterial,
    DeformationMeasure as DeformationMeasure,
    Viscosity as Viscosity,
)
from mpmjax.material._rubber import (
    AbstractRubber as AbstractRubber,
    Gent as Gent,
    MooneyRivlin as MooneyRivlin,
    Ogden as Ogden,
    Yeoh as Yeoh,
)
