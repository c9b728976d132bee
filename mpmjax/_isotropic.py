"""Functions of symmetric matrices, f(S) = V diag(f(s)) Vᵀ for S = V diag(s) Vᵀ: the logarithm, powers.

Their derivatives do not differentiate V, which has none where eigenvalues coincide (F = I, the first step of every
scene). They are written in divided differences of f, which are finite there: with A and B in the frame V,

    (Df[A])_ij = f[s_i, s_j] A_ij,
    (D²f[A, B])_ij = Σ_k f[s_i, s_k, s_j] (A_ik B_kj + B_ik A_kj)

(J. L. Daleckii, S. G. Krein; N. J. Higham, Functions of Matrices, SIAM 2008, theorem 3.11 and its proof,
doi 10.1137/1.9780898717778). First and second derivatives hold at every S; third ones are refused. In the parameters
of f, if it has any, Df and f are differentiated as they stand: the derivative is again a function of S in this frame.

Each function finds the frame for itself; XLA merges equal ones, so that several functions of one S cost one frame.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import _linalg as la
from mpmjax._types import Array, Matrix

_CLOSE = 1e-4
"""Where three eigenvalues lie within this share of each other, f[a, b, c] is f''/2 at their mean, off by the share's
square; elsewhere it is a quotient of differences, off by rounding over the share."""


class AbstractSpectral(eqx.Module):
    """A function f of an eigenvalue, and of symmetric matrices by it."""

    @abc.abstractmethod
    def of(self, s: Array) -> Array:
        """f(s)."""

    @abc.abstractmethod
    def slope(self, a: Array, b: Array) -> Array:
        """The divided difference f[a, b] = (f(a) − f(b))/(a − b), f'(a) where they are equal, to rounding."""

    @abc.abstractmethod
    def curvature(self, s: Array) -> Array:
        """f''(s)."""

    def __call__(self, S: Matrix) -> Matrix:
        """f(S). Only the upper triangle is read.

        Args:
            S: symmetric, shape (d, d, *batch).
        """
        return _function(self, S)


class Logarithm(AbstractSpectral):
    """log S, of positive definite S."""

    def of(self, s: Array) -> Array:
        """ln s."""
        return jnp.log(s)

    def slope(self, a: Array, b: Array) -> Array:
        """ln(b/a)/(b − a)."""
        gap = (b - a) / a
        return jnp.where(gap == 0, 1, jnp.log1p(gap) / jnp.where(gap == 0, 1, gap)) / a

    def curvature(self, s: Array) -> Array:
        """−1/s²."""
        return -1 / s**2


class PowerLessOne(AbstractSpectral):
    """eᶜ Sᵃ − I, of positive definite S: exactly zero for a = c = 0, and to rounding of itself near there."""

    exponent: Array
    """a [-], shape (*batch)."""
    shift: Array
    """c [-], shape (*batch)."""

    def of(self, s: Array) -> Array:
        """exp(a ln s + c) − 1."""
        return jnp.expm1(self.exponent * jnp.log(s) + self.shift)

    def slope(self, a: Array, b: Array) -> Array:
        """eᶜ (bᵃ − aᵃ)/(b − a), the exponent upstairs."""
        gap = (b - a) / a
        ratio = jnp.expm1(self.exponent * jnp.log1p(gap)) / jnp.where(gap == 0, 1, gap)
        return self._power(a) * jnp.where(gap == 0, self.exponent, ratio) / a

    def curvature(self, s: Array) -> Array:
        """a (a − 1) eᶜ sᵃ⁻²."""
        return self.exponent * (self.exponent - 1) * self._power(s) / s**2

    def _power(self, s: Array) -> Array:
        return jnp.exp(self.exponent * jnp.log(s) + self.shift)


class _Change(AbstractSpectral):
    """The change of a function by its parameters, a function of the same eigenvalue."""

    function: AbstractSpectral
    change: AbstractSpectral
    """Of the function's class, each parameter its rate."""

    def of(self, s: Array) -> Array:
        return self._along(lambda f: f.of(s))

    def slope(self, a: Array, b: Array) -> Array:
        return self._along(lambda f: f.slope(a, b))

    def curvature(self, s: Array) -> Array:
        return self._along(lambda f: f.curvature(s))

    def _along(self, value: Callable[[Any], Array]) -> Array:
        return jax.jvp(value, (self.function,), (self.change,))[1]


@jax.custom_jvp
def _function(f: AbstractSpectral, S: Matrix) -> Matrix:
    s, V = la.symmetric_eigen(S)
    return _from_frame(V, la.diagonal(f.of(s)))


@_function.defjvp
def _function_jvp(primals: Any, tangents: Any) -> Any:
    (f, S), (df, dS) = primals, tangents
    change = _differential(f, S, dS)
    if jax.tree.leaves(f):
        change = change + _function(_Change(f, df), S)
    return _function(f, S), change


@jax.custom_jvp
def _differential(f: AbstractSpectral, S: Matrix, A: Matrix) -> Matrix:
    """Df(S)[A]."""
    s, V = la.symmetric_eigen(S)
    return _from_frame(V, f.slope(s[:, None], s[None]) * _in_frame(V, A))


@_differential.defjvp
def _differential_jvp(primals: Any, tangents: Any) -> Any:
    (f, S, A), (df, dS, dA) = primals, tangents
    change = _differential(f, S, dA) + _second_differential(f, S, A, dS)
    if jax.tree.leaves(f):
        change = change + _differential(_Change(f, df), S, A)
    return _differential(f, S, A), change


@jax.custom_jvp
def _second_differential(f: AbstractSpectral, S: Matrix, A: Matrix, B: Matrix) -> Matrix:
    """D²f(S)[A, B]."""
    s, V = la.symmetric_eigen(S)
    A, B = _in_frame(V, A), _in_frame(V, B)
    directions = range(s.shape[0])

    def divided(*three: Array) -> Array:
        low, middle, high = jnp.sort(jnp.stack(three), axis=0)
        close = high - low <= _CLOSE * (jnp.abs(low) + jnp.abs(high))
        apart = (f.slope(middle, high) - f.slope(low, middle)) / jnp.where(close, 1, high - low)
        return jnp.where(close, f.curvature((low + middle + high) / 3) / 2, apart)

    def entry(i: int, j: int) -> Array:
        terms = [divided(s[i], s[k], s[j]) * (A[i, k] * B[k, j] + B[i, k] * A[k, j]) for k in directions]
        return sum(terms[1:], terms[0])

    return _from_frame(V, la.assemble([[entry(i, j) for j in directions] for i in directions]))


@_second_differential.defjvp
def _second_differential_jvp(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError(
        "Functions of a strain's principal values have first and second derivatives, no third one: with Hencky's law "
        "and those that yield take first derivatives through implicit steps, and second ones through explicit steps "
        "only."
    )


def _in_frame(V: Matrix, A: Matrix) -> Matrix:
    return la.matmul(la.transpose(V), la.matmul(A, V))


def _from_frame(V: Matrix, A: Matrix) -> Matrix:
    return la.matmul(V, la.matmul(A, la.transpose(V)))
