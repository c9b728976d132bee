"""Two elastic disks that collide."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax.discretisation import Grid
from mpmjax.geometry import Ball
from mpmjax.material import AbstractMaterial, NeoHookean
from mpmjax.state import Particles, Scene, fill


class TwoDisks(eqx.Module):
    """Two disks that move along a diagonal, collide and part (the scene of D. Sulsky, Z. Chen, H. L. Schreyer, Comput.
    Methods Appl. Mech. Eng. 118 (1994) 179, doi 10.1016/0045-7825(94)90112-0).

    No exact motion is known. The momentum is zero at all times, the disks touch at t = (‖Δcentre‖ − 2R)/‖Δv‖, and the
    energy never grows.

    Args:
        radius: radius R [m].
        centre: the centres of the disks are ±(centre, centre) [m].
        speed: their initial velocities are ∓(speed, speed) [m/s].
        density: ρ0 [kg/m²].
        material: the law of both.
    """

    radius: float = 0.2
    centre: float = 0.3
    speed: float = 0.1
    density: float = 1e3
    material: AbstractMaterial = NeoHookean(1e3, 0.3)

    @property
    def contact_time(self) -> float:
        """Time at which the circles touch [s]."""
        return (2**0.5 * self.centre - self.radius) / (2**0.5 * self.speed)

    def discretise(
        self, cells: int = 20, *, per_side: int = 2, fitted: bool = False, **choices: Any
    ) -> tuple[Scene, Particles]:
        """Scene and particles, with `cells` grid cells to a metre and `per_side` particles to the side of a cell.

        Args:
            cells: grid cells to a metre.
            per_side: particles to the side of a cell.
            fitted: whether they are fitted to the circles (see `fill`).
            choices: kernel, gradient and transfer of the scene.
        """
        half = round(0.75 * cells)
        grid = Grid((2 * half + 1,) * 2, 1 / cells, origin=(-half,) * 2)
        disks = [
            fill(
                Ball((side * self.centre,) * 2, self.radius),
                grid,
                particles_per_cell=per_side**2,
                density=self.density,
                velocity=(-side * self.speed,) * 2,
                fitted=fitted,
            )
            for side in (-1, 1)
        ]
        return Scene(grid, self.material, **choices), jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *disks)
