"""Parts behind the open doors of the engine, which it does not name."""

from mpmjax.extensions._rigid import Rigid as Rigid
from mpmjax.extensions._volume_preconditioner import VolumePreconditioner as VolumePreconditioner
