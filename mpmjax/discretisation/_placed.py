"""Sums that read the particles' places in place of their stencils' factors."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad

from mpmjax._types import Array
from mpmjax.discretisation._stencil import Places
from mpmjax.native import native_primitive, sums_fit

_PLACES, _FACTORS = 4, 3
"""How many arguments places and factors are."""
_placed: dict[Primitive, Primitive] = {}


@runtime_checkable
class Factored(Protocol):
    """A stencil, as factors and perhaps in compressed form."""

    @property
    def factors(self) -> tuple[Array, Array, Array]:
        """Terms of the flat node index, weights and their derivatives, each (d, s, p)."""
        ...

    @property
    def places(self) -> Places | None:
        """The compressed form, if there is one."""
        ...


def bound(primitive: Primitive, stencil: Factored, *args: Array, **params: Any) -> list[Array]:
    """A sum over a stencil, from places where it has them. The factors are arguments too. Slopes are theirs, and so is
    the sum by XLA; where the native library sums from places and nothing is differentiated, XLA does not compute
    them."""
    places = stencil.places
    if places is None:
        return primitive.bind(*stencil.factors, *args, **params)
    compressed = places.first, places.strides, places.offset, places.polynomials
    return _placed[primitive].bind(*compressed, *stencil.factors, *args, **params)


def define_placed(
    primitive: Primitive,
    function: Callable[..., list[Array]],
    shapes: Callable[..., list[tuple]],
    workspace: Callable[..., tuple] | None = None,
    fits: Callable[..., bool] = sums_fit,
    aliases: dict[int, int] | None = None,
    **attributes: bool,
) -> None:
    """Define what `bound` needs of a sum of factors and other arguments, with the derivatives of that sum.

    Args:
        primitive: the sum.
        function: the function of arrays.
        shapes: the shapes of the results, as a function of the arguments.
        workspace: as in `native_primitive`, and so the next.
        fits: whether the library has a kernel for arguments.
        aliases: arguments whose memory results may take, by their numbers among those that the library is given.
        attributes: what the library is told besides.
    """

    def without_places(of: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **params: of(*args[_PLACES:], **params)

    def transpose(cotangents: list, *args: Any, **params: Any) -> list:
        return [None] * _PLACES + ad.primitive_transposes[primitive](cotangents, *args[_PLACES:], **params)

    primitive_of = native_primitive(
        f"placed_{primitive.name.split('_')[1]}",
        without_places(function),
        without_places(shapes),
        partial(_places_fit, fits),
        aliases=aliases,
        like=_PLACES + 1,
        workspace=None if workspace is None else without_places(workspace),
        unread=tuple(range(_PLACES, _PLACES + _FACTORS)),
        placed=True,
        **attributes,
    )
    ad.primitive_jvps[primitive_of] = lambda primals, tangents, **params: ad.primitive_jvps[primitive](
        primals[_PLACES:], tangents[_PLACES:], **params
    )
    ad.primitive_transposes[primitive_of] = transpose
    _placed[primitive] = primitive_of


def define_jvp(primitive: Primitive, rule: Callable[..., tuple[list[Array], list[Any]]]) -> None:
    """Define the forward rule of a sum, of factors and of places.

    Args:
        primitive: the sum of factors.
        rule: the rule of the sum of factors, as JAX calls it, but with a function that takes the sum as its first
            argument: from places where these are given.
    """

    def by_factors(primals: tuple, tangents: tuple, **params: Any) -> tuple[list[Array], list[Any]]:
        return rule(partial(primitive.bind, *primals, **params), primals, tangents, **params)

    def by_places(primals: tuple, tangents: tuple, **params: Any) -> tuple[list[Array], list[Any]]:
        take = partial(_placed[primitive].bind, *primals, **params)
        return rule(take, primals[_PLACES:], tangents[_PLACES:], **params)

    ad.primitive_jvps[primitive] = by_factors
    ad.primitive_jvps[_placed[primitive]] = by_places


def _places_fit(fits: Callable[..., bool], avals: Sequence[ShapedArray], batched: int) -> bool:
    *_, offset, polynomials = avals[:_PLACES]
    factors = avals[_PLACES:]
    return offset.dtype == polynomials.dtype == factors[1].dtype and fits(factors, batched)
