"""Pictures of balls in space, in numpy: perspective, a light that casts shadows, a ground with squares to measure by.

Every ball is painted exactly, the ray through a pixel's centre against the ball, and seen where it is the nearest. The
light is a camera too: what it does not see lies in shadow. How much of the sky a point sees follows from how full the
space before it is, on a lattice of cells, whose slope also tells a body's surface from its inside.

Coordinates [m] have the third axis up.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

SAMPLES = 2
"""Samples a pixel in each direction."""
SKY = 0.45
"""Brightness of what the whole sky alone lights, where 1 is white."""
SUN = 0.62
"""Brightness that the light adds to what faces it."""
PAPER = np.array([0.925, 0.93, 0.94])
"""Colour of the ground."""
PENUMBRA = 8
"""Pixels of the light over which a shadow's edge is blurred."""
TAPS = 32
"""How many of them are looked at."""
CHUNK = 4_000_000
"""Most pixels that are painted at once, for the sake of memory."""


class Camera(NamedTuple):
    """A perspective view."""

    eye: np.ndarray
    """Where it stands [m], (3,)."""
    axes: np.ndarray
    """Unit vectors to the right, down and forward in the picture, one a row, (3, 3)."""
    focal: float
    """Focal length [pixels]."""
    width: int
    """Pixels in a row."""
    height: int
    """Pixels in a column."""
    target: np.ndarray
    """The point that it looks at [m], (3,)."""

    def view(self, x: np.ndarray) -> np.ndarray:
        """Points [m], (n, 3), as seen: to the right, down, and forward of the eye [m], (n, 3)."""
        return (x.astype(np.float32) - self.eye.astype(np.float32)) @ self.axes.T.astype(np.float32)

    def project(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points appear, column and row from the upper left corner [pixels], (n, 2), and depth [m], (n,)."""
        seen = self.view(x)
        centre = np.array([self.width / 2, self.height / 2], np.float32)
        return seen[:, :2] * (self.focal / seen[:, 2:]) + centre, seen[:, 2]

    def rays(self) -> np.ndarray:
        """The directions through the pixels' centres, each of unit depth, (height · width, 3)."""
        u = (np.arange(self.width, dtype=np.float32) + 0.5 - self.width / 2) / self.focal
        v = (np.arange(self.height, dtype=np.float32) + 0.5 - self.height / 2) / self.focal
        right, down, forward = self.axes.astype(np.float32)
        return (u[None, :, None] * right + v[:, None, None] * down + forward).reshape(-1, 3)


def look(
    points: np.ndarray,
    radius: float,
    view: tuple[float, float],
    size: tuple[int, int],
    *,
    angle: float = 28.0,
    filled: float = 0.72,
) -> Camera:
    """The camera that has balls in the middle of its picture and holds them all.

    Args:
        points: their centres [m], (n, 3).
        radius: their radius [m].
        view: azimuth and elevation of the eye [degrees]. At (0, 0) the first axis points to the right and the second
            away; the eye turns to the right and rises.
        size: width and height [pixels].
        angle: what the picture's height subtends at the eye [degrees].
        filled: how much of the picture's width or height the balls take.
    """
    azimuth, elevation = np.radians(view)
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = np.array([np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    axes = np.stack([right, np.cross(right, back), -back])
    focal = size[1] / 2 / np.tan(np.radians(angle) / 2)
    target, distance = (points.min(axis=0) + points.max(axis=0)) / 2, 0.0
    for _ in range(4):  # the nearer points spread more, so that the middle depends on the distance
        offset = (points - target) @ axes.T
        distance = ((np.abs(offset[:, :2]) + radius) * (2 * focal / filled / np.array(size)) - offset[:, 2:]).max()
        slopes = offset[:, :2] / (offset[:, 2:] + distance)
        target = target + (slopes.min(axis=0) + slopes.max(axis=0)) / 2 * distance @ axes[:2]
    return Camera(target + distance * back, axes, focal, *size, target)


class Balls(NamedTuple):
    """What is painted."""

    x: np.ndarray
    """Centres [m], (n, 3)."""
    radius: np.ndarray
    """Radii [m], (n,)."""
    colour: np.ndarray
    """Red, green and blue from 0 to 1, (n, 3)."""
    slope: np.ndarray
    """Outward normal of the body's surface [-], (n, 3), added to the ball's own; zero to see the balls alone."""


def paint(camera: Camera, x: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The depth [m] of what each pixel shows (infinite where nothing is) and which ball it is (−1 where none), each
    (height · width,). What reaches behind the eye is left out; what is smaller than a pixel is painted as large as it.

    A ball at c = (X, Y, Z) is met by the ray d = (u, v, 1) where its discriminant r²|d|² − |d × c|² is positive; with u
    and v from the ball's middle, (u, v) = (X, Y) / Z + (δu, δv), d × c = (Z δv, −Z δu, Y δu − X δv) cancels nothing.
    """
    seen, kept = camera.view(x), np.arange(len(x))
    radius = np.maximum(radius.astype(np.float32), 0.75 * seen[:, 2] / np.float32(camera.focal))
    shown = seen[:, 2] > 1.01 * radius
    seen, kept, radius = seen[shown], kept[shown], radius[shown]
    depth = seen[:, 2:]
    # Tangents from the eye, in the plane of each axis of the picture with the depth.
    reach = radius[:, None] * np.sqrt(seen[:, :2] ** 2 + depth**2 - radius[:, None] ** 2)
    square = depth**2 - radius[:, None] ** 2
    size = np.array([camera.width, camera.height])
    first = np.ceil((seen[:, :2] * depth - reach) / square * camera.focal + size / 2 - 0.5)
    last = np.floor((seen[:, :2] * depth + reach) / square * camera.focal + size / 2 - 0.5)
    first, last = np.maximum(first, 0).astype(int), np.minimum(last, size - 1).astype(int)
    across = (last - first).max(axis=1, initial=-1) + 1
    across[(last < first).any(axis=1)] = 0
    # Windows of like size are painted together. The nearest wins: the bits of a positive float sort as it does.
    nearest = np.full(camera.width * camera.height, np.uint64(2**64 - 1))
    like = np.where(across > 8, np.ceil(8 * 1.2 ** np.ceil(np.log(np.maximum(across, 8) / 8) / np.log(1.2))), across)
    for n in np.unique(like[like > 0]).astype(int):
        of_size = np.flatnonzero(like == n)
        for part in np.array_split(of_size, -(-of_size.size * n * n // CHUNK)):
            window = np.arange(n)
            columns, rows = first[part, :1] + window, first[part, 1:] + window
            X, Y, Z = (a[:, None, None] for a in seen[part].T)
            u = ((columns + 0.5 - camera.width / 2) / camera.focal).astype(np.float32)[:, None, :]
            v = ((rows + 0.5 - camera.height / 2) / camera.focal).astype(np.float32)[:, :, None]
            du, dv = u - X / Z, v - Y / Z
            a = 1 + u**2 + v**2
            r = radius[part, None, None]
            discriminant = r**2 * a - (Z**2 * (du**2 + dv**2) + (Y * du - X * dv) ** 2)
            met = (discriminant > 0) & (columns[:, None, :] < camera.width) & (rows[:, :, None] < camera.height)
            at = (X * u + Y * v + Z - np.sqrt(np.maximum(discriminant, 0))) / a
            key = at.view(np.uint32).astype(np.uint64) << np.uint64(32) | kept[part, None, None].astype(np.uint64)
            np.minimum.at(nearest, (rows[:, :, None] * camera.width + columns[:, None, :])[met], key[met])
    empty = nearest == np.uint64(2**64 - 1)
    at = (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32)
    owner = (nearest & np.uint64(2**32 - 1)).astype(np.int64)
    return np.where(empty, np.float32(np.inf), at), np.where(empty, -1, owner)


class Surroundings(NamedTuple):
    """How full space is, on a lattice of cells."""

    origin: np.ndarray
    """The lattice's lower corner [m], (3,)."""
    cell: float
    """The side of a cell [m]."""
    fields: dict[float, np.ndarray]
    """The filled fraction over Gaussians of so many cells."""

    def at(self, field: np.ndarray, x: np.ndarray) -> np.ndarray:
        """A field at points [m], (n, 3), by linear interpolation, (n,)."""
        place = (x - self.origin.astype(x.dtype)) * (1 / self.cell) - 0.5
        return ndimage.map_coordinates(field, place.T, order=1, mode="nearest", output=np.float32)

    def sky(self, x: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """How open the space before a surface is, from 0 to 1: the filled fraction in front of the points x [m],
        (n, 3), beyond that in front of a plane, the mean over near and far."""
        shut = np.zeros(len(x), np.float32)
        for width, field in self.fields.items():
            shut += np.maximum(self.at(field, x + normal * np.float32(1.5 * width * self.cell)) - 0.067, 0)
        return 1 / (1 + 6 * shut / len(self.fields))


def surroundings(
    x: np.ndarray, volume: np.ndarray, ground: float | None, *, most: int = 90, margin: int = 14
) -> tuple[Surroundings, np.ndarray]:
    """The lattice of particles at x [m], (p, 3), with these volumes [m³], (p,), above a ground at this height [m], on
    at most so many cells in a direction; and the particles' outward slopes (p, 3), about 1 at the surface of a body,
    0 in its inside and where a particle is alone."""
    lower, upper = x.min(axis=0), x.max(axis=0)
    cell = max(float(np.mean(volume)) ** (1 / 3), float((upper - lower).max()) / most)
    origin = lower - (margin + 0.5) * cell
    shape = tuple(((upper - lower) / cell + 2 * margin + 2).astype(int))
    index = np.ravel_multi_index(tuple(((x - origin) / cell).astype(int).T), shape)
    fraction = np.bincount(index, volume / cell**3, minlength=int(np.prod(shape))).reshape(shape).astype(np.float32)
    about = Surroundings(origin, cell, {})
    blurred = ndimage.gaussian_filter(fraction, 1.5)
    here = np.maximum(about.at(blurred, x), 0.2)
    slope = np.stack([about.at(np.gradient(blurred, axis=a), x) * (-1.5 / here) for a in range(3)], axis=1)
    if ground is not None:
        fraction[:, :, origin[2] + (np.arange(shape[2]) + 0.5) * cell < ground] = 1
    for width in (2.0, float(np.clip((max(shape) - 2 * margin) / 8, 1.0, 5.0))):
        about.fields[width] = ndimage.gaussian_filter(fraction, width, mode="nearest", truncate=3)
    return about, slope


def _lit(light: Camera, depth: np.ndarray, x: np.ndarray) -> np.ndarray:
    """How much of the light reaches points [m], (n, 3), from 0 to 1: a mean over a disk of the light's pixels."""
    place, far = light.project(x)
    ringed = np.pad(depth.reshape(light.height, light.width), PENUMBRA, constant_values=np.inf)
    limits = (light.width, light.height)
    inside = ((place >= 0) & (place < limits)).all(axis=1)
    column, row = place[inside].astype(int).T + PENUMBRA
    base, far, flat = row * ringed.shape[1] + column, far[inside], ringed.ravel()
    reaching = np.zeros(len(base), np.float32)
    k = np.arange(TAPS)
    out, around = (PENUMBRA - 1) * np.sqrt((k + 0.5) / TAPS), k * np.pi * (3 - np.sqrt(5))  # a sunflower's seeds
    for i, j in zip(np.rint(out * np.sin(around)).astype(int), np.rint(out * np.cos(around)).astype(int), strict=True):
        reaching += flat.take(base + (i * ringed.shape[1] + j)) > far
    result = np.ones(len(x), np.float32)
    result[inside] = reaching / TAPS
    return result


def _lines(x: np.ndarray, square: float, pixel: np.ndarray) -> np.ndarray:
    """How much of a pixel of this size [m], (n,), about points on the ground [m], (n, 2), is a line of the squares."""
    half = np.float32(0.008 * square)
    away = np.abs(x - square * np.round(x / square)).min(axis=1)
    return np.clip((half + pixel / 2 - away) / pixel, 0, np.minimum(1, 2 * half / pixel))


def picture(
    camera: Camera, light: Camera, balls: Balls, *, about: Surroundings, ground: float | None, square: float
) -> np.ndarray:
    """The picture, red, green and blue from 0 to 1, (height, width, 3).

    Args:
        camera: the view.
        light: a camera far away in the light's place, that holds all that casts shadows.
        balls: what is seen.
        about: the filled space that blocks the sky's light.
        ground: height of the ground [m]; None for none. It is not seen from below.
        square: the side of the squares drawn on it [m].
    """
    fine = camera._replace(focal=camera.focal * SAMPLES, width=camera.width * SAMPLES, height=camera.height * SAMPLES)
    eye, rays = camera.eye.astype(np.float32), fine.rays()
    depth, owner = paint(fine, balls.x, balls.radius)
    shadow, _ = paint(light, balls.x, balls.radius)
    # The light is looked for a little before a body's surface, so that it does not shade itself by its own bumps.
    to_light = np.linalg.norm(light.eye - light.target)
    clearance = np.float32(1.5 * np.median(balls.radius) + PENUMBRA * to_light / light.focal)
    sun = -light.axes[2].astype(np.float32)

    def shade(x: np.ndarray, normal: np.ndarray, clearance: np.float32) -> np.ndarray:
        """The brightness of points with these normals; that of open ground is 1."""
        facing = np.maximum(normal @ sun, 0)
        sky = (0.6 + 0.4 * normal[:, 2]) * about.sky(x, normal)
        bright = SKY * sky + SUN * facing * _lit(light, shadow, x + clearance * normal)
        return (np.minimum(bright / (SKY + SUN * sun[2]), 1.15) ** (1 / 2.2))[:, None]

    image = np.broadcast_to(PAPER.astype(np.float32), (len(rays), 3)).copy()
    if ground is not None and eye[2] > ground:
        away = (ground - eye[2]) / np.minimum(rays[:, 2], np.float32(-1e-6))
        seen = np.flatnonzero((rays[:, 2] < 0) & (away < depth))
        owner[seen] = -1
        # Far from what stands on it the ground fades into the background.
        reach = np.float32(np.linalg.norm(camera.target - camera.eye))
        seen = seen[away[seen] < 2.1 * reach]
        x = eye + away[seen, None] * rays[seen]
        off = x - camera.target.astype(np.float32)
        near = np.maximum(1.6 - 1.6 / reach * np.sqrt((off * off).sum(axis=1)), 0)
        near, seen, x = (a[near > 0.02] for a in (np.minimum(near, 1) ** 2, seen, x))
        lines = _lines(x[:, :2], square, away[seen] / np.float32(fine.focal) / -rays[seen, 2])
        level = np.broadcast_to(np.array([0, 0, 1], np.float32), x.shape)
        tone = shade(x, level, np.float32(0)) * (1 - 0.12 * lines[:, None])
        image[seen] *= 1 - near[:, None] * (1 - tone)
    seen = np.flatnonzero(owner >= 0)
    who = owner[seen]
    x = eye + depth[seen, None] * rays[seen]
    normal = (x - balls.x[who]) / balls.radius[who, None] + 3 * balls.slope[who]
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    image[seen] = balls.colour[who] * shade(x, normal, clearance)
    shape = (camera.height, SAMPLES, camera.width, SAMPLES, 3)
    return np.clip(image.reshape(shape).mean(axis=(1, 3)), 0, 1)
