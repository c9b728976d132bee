"""Functions of symmetric matrices, f(S) = V diag(f(s)) Vᵀ for S = V diag(s) Vᵀ: the logarithm, powers.

The eigenvectors V have no derivative where eigenvalues coincide, as at F = I in the first step of every scene. So the
derivatives of f(S) are written with divided differences of f, which are finite there. With A and B in the frame V,

    (Df[A])_ij = f[s_i, s_j] A_ij,
    (D²f[A, B])_ij = Σ_k f[s_i, s_k, s_j] (A_ik B_kj + B_ik A_kj),

and so on: Dⁿf is the sum over all orders of its n directions (J. L. Daleckii, S. G. Krein; N. J. Higham, Functions of
Matrices, SIAM 2008, theorem 3.11 and its proof, doi 10.1137/1.9780898717778). The derivative of each is the next one,
and each is its own adjoint, so derivatives of any order and mode are right at every S. The derivative with respect to a
parameter of f is again a function of S in this frame.

Each function computes the frame. XLA merges equal computations, so several functions of one S compute it once.
"""

import abc
import itertools
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Matrix
from mpmjax.autodiff import custom_derivative, is_unknown
from mpmjax.linalg._decompositions import symmetric_eigen
from mpmjax.linalg._matrices import matmul, transpose

Frame = tuple[Array, Matrix]  # eigenvalues and eigenvectors, (d, *batch) and (d, d, *batch)

_CLOSE = 0.01
"""Relative to the sum of the outer two: the divided difference of three or more eigenvalues closer than this is a
series. Elsewhere it is a quotient of differences, with an error of rounding over this."""
_SMALL, _LAST = 0.3, 14  # where the exponential is a series, and its last power: the remainder is below 1e-16 of it
_TERMS = 6  # terms of the series after the first; the remainder is of the order 1e-12


class AbstractSpectral(eqx.Module):
    """A scalar function f of an eigenvalue, applied to symmetric matrices: f(S) = V diag(f(s)) Vᵀ."""

    @abc.abstractmethod
    def of(self, s: Array) -> Array:
        """f(s)."""

    @abc.abstractmethod
    def slope(self, a: Array, b: Array) -> Array:
        """The divided difference f[a, b] = (f(a) − f(b))/(a − b), f'(a) where they are equal, to rounding."""

    @abc.abstractmethod
    def coefficient(self, s: Array, order: int) -> Array:
        """f⁽ⁿ⁾(s)/n! for n = `order` ≥ 2."""

    def alike(self, low: Array, high: Array) -> Bool[Array, "..."]:
        """Whether f is smooth between two eigenvalues. Default: true."""
        return jnp.full(jnp.broadcast_shapes(low.shape, high.shape), True)

    def __call__(self, S: Matrix) -> Matrix:
        """f(S). Only the upper triangle is read.

        Args:
            S: symmetric, shape (d, d, *batch).
        """
        return _differential(self, S, symmetric_eigen(jax.lax.stop_gradient(S)), ())


class Logarithm(AbstractSpectral):
    """The logarithm log S of positive definite S."""

    def of(self, s: Array) -> Array:
        """ln s."""
        return jnp.log(s)

    def slope(self, a: Array, b: Array) -> Array:
        """ln(b/a)/(b − a)."""
        gap = (b - a) / a
        return jnp.where(gap == 0, 1, jnp.log1p(gap) / jnp.where(gap == 0, 1, gap)) / a

    def coefficient(self, s: Array, order: int) -> Array:
        """−(−1/s)ⁿ/n."""
        return -((-1 / s) ** order) / order


class PowerLessOne(AbstractSpectral):
    """eᶜ Sᵃ − I of positive definite S. It is zero for a = c = 0, and of full relative precision near there."""

    exponent: Array  # a [-], shape (*batch)
    shift: Array  # c [-], shape (*batch)

    def of(self, s: Array) -> Array:
        """exp(a ln s + c) − 1."""
        return jnp.expm1(self.exponent * jnp.log(s) + self.shift)

    def slope(self, a: Array, b: Array) -> Array:
        """eᶜ (bⁿ − aⁿ)/(b − a), with n the exponent."""
        gap = (b - a) / a
        ratio = jnp.expm1(self.exponent * jnp.log1p(gap)) / jnp.where(gap == 0, 1, gap)
        return self._power(a) * jnp.where(gap == 0, self.exponent, ratio) / a

    def coefficient(self, s: Array, order: int) -> Array:
        """eᶜ sᵃ Π (a − k)/((k + 1) s) over k < n."""
        return reduce(jnp.multiply, ((self.exponent - k) / ((k + 1) * s) for k in range(order)), self._power(s))

    def _power(self, s: Array) -> Array:
        return jnp.exp(self.exponent * jnp.log(s) + self.shift)


class PowerBeyondLine(PowerLessOne):
    """eᶜ Sᵃ − I − (a ln S + c I), of second order in a and c, and of full relative precision where they are small."""

    def of(self, s: Array) -> Array:
        """exp(y) − 1 − y, y = a ln s + c."""
        return exponential_beyond_line(self.exponent * jnp.log(s) + self.shift)

    def slope(self, a: Array, b: Array) -> Array:
        return super().slope(a, b) - self.exponent * Logarithm().slope(a, b)

    def coefficient(self, s: Array, order: int) -> Array:
        return super().coefficient(s, order) - self.exponent * Logarithm().coefficient(s, order)


def exponential_beyond_line(y: Array) -> Array:
    """exp(y) − 1 − y, to rounding: a series where y is small."""
    small = jnp.abs(y) < _SMALL
    x = jnp.where(small, y, 0)
    series = reduce(lambda rest, k: 1 + x / k * rest, range(_LAST, 2, -1), jnp.ones_like(x))
    return jnp.where(small, x**2 / 2 * series, jnp.expm1(y) - y)


class _Partial(AbstractSpectral):
    """The derivative of f with respect to one of its parameters, a function of the same eigenvalue."""

    function: AbstractSpectral
    parameter: int = eqx.field(static=True)  # the index of the parameter among the leaves of f

    def of(self, s: Array) -> Array:
        return self._rate(lambda f: f.of(s))

    def slope(self, a: Array, b: Array) -> Array:
        return self._rate(lambda f: f.slope(a, b))

    def coefficient(self, s: Array, order: int) -> Array:
        return self._rate(lambda f: f.coefficient(s, order))

    def alike(self, low: Array, high: Array) -> Bool[Array, "..."]:
        return self.function.alike(low, high)

    def _rate(self, value: Callable[[Any], Array]) -> Array:
        leaves, tree = jax.tree.flatten(self.function)
        ones = [jnp.ones_like(a) if k == self.parameter else jnp.zeros_like(a) for k, a in enumerate(leaves)]
        return jax.jvp(value, (self.function,), (jax.tree.unflatten(tree, ones),))[1]


@custom_derivative
def _differential(f: AbstractSpectral, S: Matrix, frame: Frame, directions: tuple[Matrix, ...]) -> Matrix:
    """Dⁿf(S)[A, B, ...] in n directions. It is computed from the frame, and differentiated with respect to S."""
    s, V = frame
    order = len(directions)
    if order == 0:
        return matmul(V * f.of(s), transpose(V))
    if order == 1:
        return _from_frame(V, f.slope(s[:, None], s[None]) * _in_frame(V, directions[0]))
    values, columns, products = list(jnp.unstack(s)), list(jnp.unstack(V, axis=1)), []  # in ascending order
    for i in [i for last in range(len(values) - 1, 0, -1) for i in range(last)]:
        swap = values[i] > values[i + 1]
        for a in (values, columns):
            a[i], a[i + 1] = jnp.where(swap, a[i + 1], a[i]), jnp.where(swap, a[i], a[i + 1])
    s, V = jnp.stack(values), jnp.stack(columns, axis=1)
    for arranged in itertools.permutations([_in_frame(V, A) for A in directions]):
        factors = (jnp.expand_dims(A, [*range(k), *range(k + 2, order + 1)]) for k, A in enumerate(arranged))
        products.append(reduce(jnp.multiply, factors))
    terms = _divided_differences(f, s, order) * reduce(jnp.add, products)
    return _from_frame(V, terms.sum(axis=tuple(range(1, order))))


@_differential.defjvp
def _differential_jvp(primals: Any, tangents: Any) -> Any:
    (f, S, frame, A), (df, dS, _, dA) = primals, tangents
    parts = [] if dS is None else [_differential(f, S, frame, (*A, dS))]
    for k, change in enumerate(dA):
        if change is not None:
            parts.append(_differential(f, S, frame, (*A[:k], change, *A[k + 1 :])))
    for k, rate in enumerate(jax.tree.structure(f).flatten_up_to(df)):
        if rate is not None:
            parts.append(rate * _differential(_Partial(f, k), S, frame, A))
    return _differential(f, S, frame, A), reduce(jnp.add, parts)


@_differential.deftranspose
def _differential_transpose(cotangent: Matrix, args: Any) -> Any:
    f, S, frame, A = args
    wanted = [is_unknown(direction) for direction in A]
    others = [cotangent if want else transpose(direction) for want, direction in zip(wanted, A, strict=True)]
    pulled = _differential(f, S, frame, tuple(others))
    nothing = jax.tree.map(lambda _: None, (f, S, frame))
    return *nothing, tuple(pulled if want else None for want in wanted)


def _divided_differences(f: AbstractSpectral, s: Array, order: int) -> Array:
    """f[s_i, s_j, ...] for all tuples of n + 1 of the d ascending values s, n = `order`, shape (d, ..., d, *batch)."""
    choices = partial(itertools.combinations_with_replacement, range(len(s)))
    quotients: dict[tuple[int, ...], Array] = {(i, j): f.slope(s[i], s[j]) for i, j in choices(2)}
    values = jnp.stack(list(quotients.values()))
    for size in range(3, order + 2):
        tuples = list(choices(size))
        x = s[np.array(tuples).T]
        low, high = x[0], x[-1]
        close = f.alike(low, high) & (high - low <= _CLOSE * (jnp.abs(low) + jnp.abs(high)))
        above, below = (jnp.stack([quotients[t[part]] for t in tuples]) for part in (slice(1, None), slice(-1)))
        values = jnp.where(close, _series(f, x), (above - below) / jnp.where(close, 1, high - low))
        quotients = dict(zip(tuples, jnp.unstack(values), strict=True))
    number = {t: k for k, t in enumerate(quotients)}
    everywhere = itertools.product(range(len(s)), repeat=order + 1)
    return values[np.reshape([number[tuple(sorted(t))] for t in everywhere], [len(s)] * (order + 1))]


def _series(f: AbstractSpectral, x: Float[Array, "k ..."]) -> Array:
    """f[x_0, ..., x_n] by Taylor's series of f about the mean m: Σ_k f⁽ⁿ⁺ᵏ⁾(m)/(n+k)! h_k(x − m), with h_k the sum of
    all products of k of the deviations, repeated ones too (C. de Boor, Surv. Approx. Theory 1 (2005) 46, section 9)."""
    mean = x.mean(axis=0)
    products = [jnp.ones_like(mean), *[jnp.zeros_like(mean)] * _TERMS]
    for deviation in x - mean:
        for k in range(1, _TERMS + 1):
            products[k] = products[k] + deviation * products[k - 1]
    return reduce(jnp.add, (f.coefficient(mean, len(x) - 1 + k) * h for k, h in enumerate(products)))


def _in_frame(V: Matrix, A: Matrix) -> Matrix:
    return matmul(transpose(V), matmul(A, V))


def _from_frame(V: Matrix, A: Matrix) -> Matrix:
    return matmul(V, matmul(A, transpose(V)))
