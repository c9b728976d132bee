"""Viscosity, added to any law."""

from typing import Any

from mpmjax._types import PerParticle
from mpmjax.checks import require, require_between, require_fields
from mpmjax.material._law import AbstractLaw, Viscosity


def _of_law(name: str) -> Any:
    return property(lambda self: getattr(self.law, name))


class Viscous(AbstractLaw):
    """A law with a Newtonian viscosity: to the law's stress is added

        σ_v = 2η dev D + ζ tr(D) I,    D = sym ∇_x v,    dev D = D − ⅓ tr(D) I (plane strain in two dimensions).

    With a fluid this gives the compressible Navier-Stokes equations, with a solid the Kelvin-Voigt model, a spring and
    a dashpot in parallel. It conserves linear and angular momentum, takes |J| V0 as the particle's volume (J = det F,
    or det F_E of a law with a history), and only dissipates energy.

    Explicit steps take the velocity gradient C that particles stored a step ago. Implicit ones solve for it in the
    configuration of the step's start: methods of second order are of first order in what a step turns or strains.
    *When it breaks*: explicit steps are limited by diffusion besides sound, dx²/ν (see `stable_dt`). APIC, PIC and FLIP
    have a numerical viscosity on the scale of the grid, in which a small η disappears: see their orders.
    *Good values*: η of water 1e-3, of oil 0.1, of honey 10 Pa s; for a solid some thousandths of E times the period
    that is to be damped: a pressure wave's amplitude falls as e^{−ω²t (4η/3 + ζ)/(2 (λ + 2μ))}.

    Args:
        law: any law, elastic, plastic or fluid.
        shear_viscosity: η [Pa s], at least 0, one value or one per particle (p,).
        bulk_viscosity: ζ [Pa s], likewise.
    """

    law: AbstractLaw
    shear_viscosity: PerParticle
    bulk_viscosity: PerParticle = 0.0

    def __check_init__(self):
        require_fields(self)
        require(self.law.viscosity is None, "Viscous takes a law that is not viscous yet: add the viscosities.")
        require(self.law.constraint is None, "Viscous takes a law that deforms: a rigid body has nothing that flows.")
        require_between("Viscous's shear_viscosity [Pa s]", self.shear_viscosity, 0, float("inf"))
        require_between("Viscous's bulk_viscosity [Pa s]", self.bulk_viscosity, 0, float("inf"))

    @property
    def viscosity(self) -> Viscosity:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The viscosity without the law."""
        return Viscosity(self.shear_viscosity, self.bulk_viscosity)

    # all else is the law's
    measure = _of_law("measure")
    allows_total = _of_law("allows_total")
    allows_averaged_volume = _of_law("allows_averaged_volume")
    relaxes_stress = _of_law("relaxes_stress")
    flows = _of_law("flows")  # pyright: ignore[reportIncompatibleMethodOverride]
    hardly_changes_volume = _of_law("hardly_changes_volume")
    initial_history = _of_law("initial_history")
    compaction = _of_law("compaction")
    elastic = _of_law("elastic")
    return_map = _of_law("return_map")
    title = _of_law("title")
    inadmissible = _of_law("inadmissible")
