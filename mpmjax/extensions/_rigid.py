"""Rigid bodies: the law that brings them, and from particles to the two nodes that move each body, and back."""

from dataclasses import replace
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Int, Mask, Matrix, NodeScalar, NodeVector, Scalar
from mpmjax.boundary import OwnedCouple
from mpmjax.checks import as_plain, positive, require, require_fields
from mpmjax.geometry import RigidBody, moment, rigid_body, rotation_of, rotation_of_chords, spinning, turn
from mpmjax.material import AbstractMaterial
from mpmjax.potential import Image, Mirror
from mpmjax.state import AbstractConstraint, AbstractLayerImage, Particles


class Rigid(AbstractMaterial):
    """A rigid body that moves as the forces on it make it: M V' = Σ f, (I ω)' = Σ r × f.

    Its particles give it mass and shape, so `fill` it with its density. Loads, gravity and contact act on it as on any
    body, and it stands in the same implicit system as what it touches. It is a body of its own: a scene with other
    materials has `bodies` (see `Bodies`).

        plate = mpm.Rigid(1e8, free=(False, True), turns=False)
        scene = mpm.Scene(grid, (rubber, plate), bodies=mpm.Bodies(), loads=mpm.PointLoad(top, (0.0, -100.0)))

    *When it breaks*: in the total description, where `RigidPart` is. A step must turn it by much less than a radian.
    What a wall, a plane or a grip holds of one of its nodes it holds of the whole body, which then does not turn,
    except as the grip does.

    *Good values*: for the modulus, some ten times that of what it touches.

    Args:
        modulus: the modulus M of pressure waves [Pa] by which contact takes its stiffness, positive: between it and
            another body M M'/(M + M').
        free: the directions in which it may move, one bool each; in the others it rests. Default: all of them.
        turns: whether it may turn.
    """

    allows_averaged_volume: ClassVar[bool] = False  # its volume does not change
    modulus: Annotated[Scalar, positive, "Pa"]
    free: tuple[bool, ...] | None = eqx.field(static=True, default=None, converter=as_plain)
    turns: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        require_fields(self)
        fits = self.free is None or len(self.free) in (1, 2, 3)
        require(fits, f"Rigid's free directions must be one bool for each of the scene's, got {self.free}.")

    def constraint(self, number: int, layer: int) -> "RigidConstraint":  # pyright: ignore[reportIncompatibleVariableOverride]
        """The constraint on how a body of it moves."""
        return RigidConstraint(number, layer, self.free, self.turns)

    def energy(self, F: Matrix) -> Array:
        return jnp.zeros(F.shape[2:], F.dtype)

    def wave_modulus(self, F: Deformation) -> Float[Array, "*p"]:
        return jnp.broadcast_to(jnp.asarray(self.modulus, F.dtype), (1,))

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.finite(F)


class RigidImage(AbstractLayerImage):
    """The velocities V + ω × r_i of the nodes of a rigid body, from two of them: the first has V and the second s = Gω,
    with GᵀG = I/M, so that both have the mass M."""

    layer: int = eqx.field(static=True)
    layers: int = eqx.field(static=True)
    arms: Float[Array, "m d"]  # r_i = x_i − c [m], shape (m, d)
    per_root: Float[Array, "r r"]  # G⁻¹ [1/m]

    def spin(self, s: Float[Array, "d"]) -> Float[Array, "r"]:
        """ω [rad/s] from the velocity of the second node [m/s]."""
        return self.per_root @ s[: len(self.per_root)]

    def scalar(self, field: NodeScalar) -> NodeScalar:
        """A map whose transpose gives both nodes the whole mass."""
        layer = self.own(field)
        return self.with_own(field, jnp.broadcast_to(layer[0] + layer[1], layer.shape))

    def vector(self, field: NodeVector) -> NodeVector:
        layer = self.own(field)
        return self.with_own(field, layer[0] + spinning(self.spin(layer[1]), self.arms))

    def places(self, carrier: NodeVector) -> Float[Array, "m d"]:
        """The velocity of the centre."""
        return jnp.broadcast_to(self.own(carrier)[0], self.arms.shape)

    def reaches(self, plane: Image, mass: NodeScalar) -> Bool[Array, "d"]:
        """The axis of a plane on or beyond which the body has mass [kg], shape (n,), as a mask of the directions."""
        there = self.own(plane.along(plane.odd <= 0)) & (self.own(mass) > 0)
        return there.any() & (jnp.arange(self.arms.shape[1]) == plane.axis)

    def first_two(self, velocity: Array, s: Array) -> NodeVector:
        """The layer's nodes with V at the first, s at the second and zero elsewhere, shape (m, d)."""
        return jnp.zeros_like(self.arms).at[0].set(velocity).at[1, : len(s)].set(s)


class RigidConstraint(AbstractConstraint):
    """The motion of a rigid body, whose nodes are folded to two of its layer (see `RigidImage`)."""

    number: int = eqx.field(static=True)
    layer: int = eqx.field(static=True)
    free: tuple[bool, ...] | None = eqx.field(static=True)
    turns: bool = eqx.field(static=True)

    @property
    def guided(self) -> bool:
        """Whether any degree of freedom is fixed."""
        return not self.turns or not all(self.free or ())

    def check(self, scene: Any) -> None:
        require(
            not scene.total,
            "A Rigid body needs nodes of its own, which the total description has not: use the updated one, or "
            "RigidPart.",
        )
        require(
            scene.layers.count(self.layer) == 1,
            "A Rigid body must be of one material alone, and no other material of its body: give the scene bodies, "
            f"Bodies() or with of_materials in which its number appears once, got {scene.layers}.",
        )
        refused = [type(boundary).__name__ for boundary in scene.boundary if not boundary.meets_constraints]
        require(
            not refused,
            f"{', '.join(refused)} cannot stand in a scene with a Rigid body: take a SeparatingBox, a "
            "SeparatingCollider, or a Grip.",
        )
        require(
            not scene.moving_mirrors,
            "A SymmetryPlane that moves cannot stand in a scene with a Rigid body: take a SeparatingCollider, or a "
            "plane at rest.",
        )
        d = scene.grid.dim
        fits = self.free is None or len(self.free) == d
        require(fits, f"Rigid's free directions must be {d} bools, as the grid has directions, got {self.free}.")

    def check_particles(self, x: np.ndarray, spacing: float) -> None:
        spread, needed = np.linalg.svd(x - x.mean(axis=0), compute_uv=False), x.shape[1] - 1
        require(
            len(spread) >= needed and spread[:needed] > 1e-6 * spacing,
            f"A Rigid body's particles must not lie {'at one point' if x.shape[1] < 3 else 'on one line'}, by which "
            f"nothing says how it turns: give material {self.number} more of them.",
        )

    def at_start(
        self, scene: Any, particles: Particles, nodes: Any, planes: Mirror
    ) -> tuple[RigidImage, NodeVector, Mask, NodeVector]:
        grid, d, conditions, dt = scene.grid, particles.dim, nodes.conditions, nodes.dt
        body, places = self._body(particles), scene.nodes(particles, 0.0)  # at any time: planes beside it rest
        root, arms = body.root(), places[: len(places) // grid.layers] - body.centre
        if any(grid.periodic):  # to the nearest image
            period = jnp.asarray(grid.shape, arms.dtype) * grid.spacing
            arms = jnp.where(jnp.asarray(grid.periodic), arms - period * jnp.round(arms / period), arms)
        image = RigidImage(self.layer, grid.layers, arms, jnp.linalg.inv(root) if len(root) else root)

        # which components of V and s are held: what is held of any of the body's nodes is held of all
        mass = image.own(nodes.mass)
        held = image.own(conditions.fixed) & (mass > 0)[:, None]
        of_planes = [image.reaches(plane, nodes.mass) for plane in planes.images if isinstance(plane, Image)]
        guided = jnp.zeros(d, bool) if self.free is None else ~jnp.asarray(self.free)
        by_nodes = held.any(axis=0)
        by_planes = jnp.stack(of_planes).any(axis=0) if of_planes else jnp.zeros(d, bool)
        spins = self.turns & ~by_nodes.any() & ~by_planes.any()
        both = jnp.stack([guided | by_nodes | by_planes, jnp.broadcast_to(~spins, (d,))])

        # at what velocity [m/s]: that of the rigid motion nearest to what is prescribed, from its mean, and from the
        # turning of what is prescribed with all components
        weight = jnp.where(held, mass[:, None], 0)
        total = weight.sum(axis=0)
        per_total = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)
        value = image.own(conditions.velocity)
        mean, middle = per_total * (weight * value).sum(axis=0), per_total * (weight * arms).sum(axis=0)
        whole = jnp.where(held.all(axis=1), mass, 0)
        chords = jnp.where((whole > 0)[:, None], arms - middle, 0)
        angle = jnp.where(self.turns, rotation_of_chords(chords, dt * (value - mean), whole), 0)
        back = turn(middle[None], angle)[0] - middle if len(angle) else 0.0  # the centre too moves along its chord
        value = image.first_two(jnp.where(by_nodes & ~guided, mean - back / dt, 0), root @ angle / dt)[:2]
        fixed = jnp.zeros(arms.shape, bool).at[:2].set(both)
        prescribed = jnp.zeros_like(arms).at[:2].set(jnp.where(both, value, 0))
        return image, image.first_two(body.velocity, root @ body.spin), fixed, prescribed

    def moved(
        self,
        before: Particles,
        after: Particles,
        image: RigidImage,
        fixed: Mask,
        new: NodeVector,
        mean: NodeVector,
        dt: Scalar,
    ) -> Particles:
        """The particles moved as one, whatever the transfer:

            c ← c + Δt V̄,    x_p ← c + R (x_p − c),    v_p ← V + ω × (x_p − c),    F_p ← R F_p,

        where R is the rotation at the mean angular momentum I ω̄, and the spin at the end has the angular momentum after
        the step; of a body whose spin is prescribed, R is the rotation by Δt ω̄ and the spin is that.
        """
        rows, body = before.groups[self.number].rows, self._body(before)
        end, over, dtype = image.own(new), image.own(mean), before.x.dtype
        R = rotation_of(body, body.inertia @ image.spin(over[1]), dt)
        momentum = body.inertia @ image.spin(end[1])
        spin = momentum / body.inertia.diagonal()
        if before.dim == 3:  # else the inertia does not turn, and what is held is the same
            spin = R @ jnp.linalg.solve(body.inertia, R.T @ momentum)  # (R I Rᵀ)⁻¹ L
            held, axes = image.own(fixed)[1].any(), jnp.eye(3, dtype=dtype)
            R = jnp.where(held, turn(axes, dt * image.spin(over[1])).T, R)
            spin = jnp.where(held, image.spin(end[1]), spin)
        arms, C, deformations = (R @ body.arms.T).T, after.C, list(after.deformations)
        deformations[self.number] = R @ jnp.asarray(before.deformations[self.number])
        if C is not None:
            C = C.at[rows].set(spinning(spin, jnp.eye(before.dim, dtype=dtype)).T)
        x = after.x.at[rows].set(body.centre + dt * over[0] + arms)
        v = after.v.at[rows].set(end[0] + spinning(spin, arms))
        return replace(after, x=x, v=v, C=C, deformations=tuple(deformations))

    def received(
        self,
        image: RigidImage,
        owners: Int[Array, "n d"],
        planes: list[tuple[int, Image]],
        loose: tuple[NodeScalar, NodeVector],
        tied: tuple[NodeScalar, NodeVector],
        guide: int | None,
    ) -> tuple[Int[Array, "n d"], OwnedCouple]:
        """The body's own guides hold what they forbid, else the first one holds. Directions in which nothing is held
        add up to no force; their moment is that of who holds the spin, or of the guides, about the body's centre then
        none."""
        layer, mass = image.own(owners), image.own(loose[0])
        nobody = jnp.iinfo(layer.dtype).max
        first = jnp.where((layer >= 0) & (mass > 0)[:, None], layer, nobody).min(axis=0)
        for number, plane in planes:
            first = jnp.where(image.reaches(plane, loose[0]), jnp.minimum(first, number), first)
        of_spin = first.min()
        if guide is not None:
            of_spin = jnp.where(self.turns & (of_spin < nobody), of_spin, guide)
        first = jnp.where(first == nobody, of_spin, first)
        if guide is not None and self.free is not None:
            first = jnp.where(jnp.asarray(self.free), first, guide)
        first, of_spin = (jnp.where(number == nobody, -1, number) for number in (first, of_spin))

        # the change of its angular momentum Iω less that of its nodes, which have an inertia and a spin of their own
        rank, of_second = len(image.per_root), image.own(tied[0])[1] * image.own(tied[1])[1]
        angular = jnp.linalg.solve(image.per_root.T, of_second[:rank]) if rank else of_second[:0]  # Iω = Gᵀ M s
        couple = angular - moment(image.arms, mass[:, None] * image.own(loose[1])).sum(axis=0)
        owners = image.with_own(owners, jnp.broadcast_to(first, layer.shape))
        return owners, OwnedCouple(couple, of_spin)

    def kinetic_energy(self, x: Array, v: Array, mass: Array, volume: Array) -> Float[Array, ""]:
        """½ M ‖V‖² + ½ ω·Iω."""
        body = rigid_body(x, v, mass, volume)
        return (body.mass * (body.velocity**2).sum() + body.spin @ body.inertia @ body.spin) / 2

    def _body(self, particles: Particles) -> RigidBody:
        rows = particles.groups[self.number].rows
        return rigid_body(particles.x[rows], particles.v[rows], particles.mass[rows], particles.volume[rows])
