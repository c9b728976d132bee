"""Parts behind the open doors of the engine, which it does not name."""

from mpmjax.extensions._active import Active as Active
from mpmjax.extensions._density_correction import DensityCorrection as DensityCorrection
from mpmjax.extensions._inlet import Controls as Controls, Inlet as Inlet, Outlet as Outlet
from mpmjax.extensions._rigid import Rigid as Rigid
from mpmjax.extensions._volume_preconditioner import VolumePreconditioner as VolumePreconditioner
