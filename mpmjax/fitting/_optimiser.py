"""Methods that search the least Σ r²: Levenberg-Marquardt by the Jacobian, L-BFGS and Adam of optax by the gradient."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import as_floats, positive, require_fields, require_positive, tolerance, whole
from mpmjax.fitting._evaluation import Evaluation, of_residuals
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._search import AbstractOptimiser, Search


class LevenbergMarquardt(AbstractOptimiser):
    """The Levenberg-Marquardt method: steps −(JᵀJ + λ)⁻¹ Jᵀ r of the residuals r and their Jacobian J.

    λ is first one, the square of a coordinate's natural step; it falls by 3.5 where a step lowers Σ r² as foretold, and
    grows fourfold where one does not lower it by a hundredth of that, or a simulation fails: that one is not taken. It
    is larger where a number with a bound would move by more than 2 in its coordinate, a modulus sevenfold, or a quarter
    of that for each refusal before. From the second refusal on a step is a quarter of the refused one at most, and half
    of one that brought less than a quarter of what was foretold. Near a bound, which hides the value from its
    coordinate, damping holds a step that the data ask for: there the next one is the Gauss-Newton step of values that
    follow their coordinates in straight lines up to their bounds.

    It ends where a step changes nothing by more than the tolerance, where the next Gauss-Newton step, no longer than to
    a bound, is less than a ten-thousandth of the standard error that the misfit gives, or where one is refused and
    could lower Σ r² by no more than its rounding, or a hundredth of the variance σ² = Σ r²/(m − n). Where six
    iterations, half of them refused, lower it by less than a tenth of σ² or a ten-thousandth, and move no coordinate by
    more than 0.03, or steps are far shorter than Gauss-Newton's, the misfit has a kink or simulations fail beyond: it
    ends, and has not converged.

    Args:
        rtol: relative and absolute tolerance of coordinates and residuals.
        max_steps: most iterations.
        mode: of the Jacobian, see `FitProblem.jacobian`. Default: the cheaper one.
    """

    rtol: Annotated[Scalar, tolerance] = 1e-6
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=300)
    mode: Literal["forward", "reverse"] | None = eqx.field(static=True, default=None)

    def begin(self, problem: FitProblem, z: Coordinates) -> "DampedState":
        no = jnp.asarray(False)
        return DampedState(z, z, jnp.ones((), z.dtype), jnp.zeros((), jnp.int32), no, no)

    def place(self, problem: FitProblem, state: "DampedState") -> Coordinates | None:
        return state.trial if (self.mode or problem.cheaper_mode) == "forward" else None

    def iterate(self, problem: FitProblem, state: "DampedState") -> tuple["DampedState", Evaluation]:
        z = state.trial.astype(problem.dtype)
        return state, of_residuals(*problem.jacobian(z, self.mode), problem.room(z))

    def directed(self, before: Search, state: "DampedState", seen: Evaluation) -> tuple["DampedState", Evaluation]:
        z, reach, refused, longest, settled, stalled = state.trial, float(state.reach), 0, np.inf, False, False
        if before.history:
            last, tried, moved = _Lines.at(before.seen), _Lines.at(seen), np.asarray(z - before.z, float)
            gain = _gain(last, tried, moved)
            if gain >= _LEAST_GAIN:
                reach *= _LONGER if gain > _GOOD_GAIN else 1
                longest = np.abs(moved).max() / 2 if gain < _POOR_GAIN else np.inf
                changes, sizes = np.append(moved, tried.r - last.r), np.abs(np.append(z, tried.r))
                settled = bool((np.abs(changes) < float(self.rtol) * (1 + sizes)).all())
            else:
                z, seen, refused, reach = before.z, before.seen, int(state.refused) + 1, reach / _SHORTER
                longest = np.abs(moved).max() / _SHORTER if refused > 1 else np.inf
            stalled = _leads_nowhere(before, z, last, min(tried.square, last.square))
        lines = _Lines.at(seen)
        if not np.isfinite(lines.J).all():
            return state._replace(z=z), seen
        bent = np.isfinite(lines.room).any(axis=0)  # coordinates of numbers with a bound
        step = _damped(lines, reach, np.minimum(np.where(bent, _FURTHEST / _SHORTER**refused, np.inf), longest))
        newton, limited = lines.gauss_newton()
        wanted = np.abs(newton[~limited]).max(initial=0)
        held = wanted > _FAR * float(self.rtol) and (stalled or np.abs(step).max() < _REFUSED * wanted)
        over = settled or stalled
        straight = _beside_a_bound(lines, newton / _SHORTER**refused, step, not refused and np.isinf(longest))
        if straight is not None:
            step, reach = straight, reach * _SHORTER  # if it is refused, damping is as if it had not been tried
        after = z, np.asarray(z, float) + step, reach, refused, over and not held, over and held
        return DampedState(*(jnp.asarray(a, leaf.dtype) for a, leaf in zip(after, state, strict=True))), seen

    def has_converged(self, state: "DampedState", seen: Evaluation) -> bool:
        if state.settled or self.distance(state, seen) <= 1:
            return True
        # Refused, and what it could have lowered Σ r² by is lost in the rounding, or a tenth of a standard error away.
        lines = _Lines.at(seen)
        rounding = _ROUNDINGS * float(np.finfo(np.asarray(seen.residuals).dtype).eps)
        share = max(rounding, _LITTLE / max(lines.freedom, 1))
        return bool(state.refused > 0 and lines.after(lines.gauss_newton()[0]) >= (1 - share) * lines.square)

    def distance(self, state: "DampedState", seen: Evaluation) -> float:
        lines = _Lines.at(seen)
        step, limited = lines.gauss_newton()
        if lines.freedom <= 0 or not np.isfinite(step).all():
            return float("nan")
        error = np.sqrt(lines.square / lines.freedom)
        # Data without noise leave no error to compare with: towards a bound the tolerance of residuals ends it.
        least = float(self.rtol) if limited.any() and np.abs(step[~limited]).max(initial=0) <= self.rtol else 0.0
        length = float(np.linalg.norm(lines.J @ step))
        return length / max(_NEGLIGIBLE * float(error), least) if length > 0 else 0.0


class DampedState(NamedTuple):
    """State of Levenberg-Marquardt."""

    z: Coordinates  # where it is
    trial: Coordinates  # where it looks next
    reach: Float[Array, ""]  # one over the damping
    refused: Int[Array, ""]  # how many steps in a row were refused
    settled: Bool[Array, ""]  # whether the last step was within the tolerances
    stalled: Bool[Array, ""]  # whether it leads nowhere: the misfit has a kink, or simulations fail beyond


class _Lines(NamedTuple):
    """Residuals as straight lines in the coordinates, r + J Δ, in double precision."""

    r: np.ndarray
    J: np.ndarray
    room: np.ndarray  # see `FitProblem.room`

    @classmethod
    def at(cls, seen: Evaluation) -> "_Lines":
        """Lines at a place."""
        return cls(*(np.asarray(a, float) for a in (seen.residuals, seen.jacobian, seen.room)))

    @property
    def square(self) -> float:
        """Σ r²."""
        return (self.r**2).sum()

    @property
    def freedom(self) -> int:
        """Degrees of freedom m − n."""
        return self.J.shape[0] - self.J.shape[1]

    def after(self, step: np.ndarray) -> float:
        """Σ r² after a step."""
        return ((self.r + self.J @ step) ** 2).sum()

    def gauss_newton(self) -> tuple[np.ndarray, np.ndarray]:
        """The Gauss-Newton step of values that are straight lines up to their bounds, NaN if not known, and which are
        brought to one."""
        r, J, room = self
        if not (np.isfinite(r).all() and np.isfinite(J).all()):
            return np.full(J.shape[1], np.nan), np.zeros(J.shape[1], bool)
        length = np.where((norm := np.linalg.norm(J, axis=0)) > 0, norm, 1)
        down, up = room * length
        step = np.linalg.lstsq(J / length, -r, rcond=1e-10)[0]
        if ((step <= -down) | (step >= up)).any():
            from scipy.optimize import lsq_linear  # here, since it takes long to import

            step = lsq_linear(J / length, -r, (-down, up), method="bvls").x
        return step / length, np.asarray((step <= -down) | (step >= up))


def _gain(last: _Lines, tried: _Lines, moved: np.ndarray) -> float:
    """The part of the foretold decrease that a step brought, NaN where the simulation failed."""
    # Near a bound the quadratic, of coordinates, may foretell a step uphill: none is taken.
    foretold, change = last.after(moved) - last.square, tried.square - last.square
    return change / foretold if foretold < 0 else _POOR_GAIN if change <= 0 else np.nan


def _leads_nowhere(before: Search, z: Coordinates, last: _Lines, lowest: float) -> bool:
    """Whether the latest iterations, half of them refused, have hardly moved, nor lowered Σ r² to its `lowest`."""
    lately = before.history[-_LATELY:]
    often = len(lately) == _LATELY and sum(not i.accepted for i in lately) >= _LATELY / 2
    near = bool((np.abs(z - lately[0].z) <= _NOWHERE).all())
    slow = max(_SLOW / max(last.freedom, 1), _LITTLE**2) * last.square
    return often and near and 2 * lately[0].cost - lowest <= slow


def _damped(lines: _Lines, reach: float, furthest: np.ndarray) -> np.ndarray:
    """The step −(JᵀJ + λ)⁻¹ Jᵀ r with the smallest λ, one over the reach at least, that moves no coordinate further."""
    U, lengths, Vt = np.linalg.svd(lines.J, full_matrices=False)
    damping = 1 / np.clip(reach, *_REACHES)
    damping = np.append(damping, np.maximum(damping, lengths[0] ** 2 * np.logspace(-16, 8, 97)))
    steps = -Vt.T @ ((lengths * (U.T @ lines.r))[:, None] / (lengths[:, None] ** 2 + damping))
    short = (np.abs(steps) <= furthest[:, None]).all(axis=0)
    return steps[:, short.argmax() if short.any() else -1]


def _beside_a_bound(lines: _Lines, step: np.ndarray, damped: np.ndarray, surely: bool) -> np.ndarray | None:
    """A Gauss-Newton step with straight lines of values beside bounds, where damping holds one that leaves a bound,
    hidden by it, or, if it is sure, any where Σ r² has come to noise; else None."""
    left = lines.after(step)
    limit = _NEAR**2 * left / max(lines.freedom, 1)  # of Δχ², by which chance puts a minimum beyond a bound
    (down, up), square = lines.room, np.maximum((lines.J**2).sum(axis=0), np.finfo(float).tiny)
    near = square * np.minimum(down, up) ** 2 <= limit
    least = np.exp(-_LEAP) - 1
    straight = np.log1p(np.maximum(step / down, least)) - np.log1p(np.maximum(-step / up, least))
    wanted = np.where(near, straight, step)
    held = (near & (np.abs(damped) < np.abs(wanted) / 2)).any() and lines.freedom > 0
    hidden = (near & np.where(step > 0, up > _HIDDEN * down, down > _HIDDEN * up)).any()
    leaves = hidden and (np.abs(step[~near]) <= _FURTHEST).all()
    noise = surely and lines.square - left <= limit * len(step)
    return wanted if held and (leaves or noise) else None


class LBFGS(AbstractOptimiser):
    """The limited-memory BFGS method of optax with its zoom line search, on gradients by reverse mode.

    An iteration is a line search: mostly one simulation with its gradient, whatever the number of parameters. Where a
    simulation or its derivative fails the cost is infinite. A line search that finds nothing lower is begun again along
    the negative gradient; where that finds nothing either, the search ends, and has not converged. It has where two in
    a row bring the cost, ½ Σ r², less than `rtol`² σ² lower, foreseen and done, σ² = Σ r²/(m − n): some `rtol` standard
    errors from the minimum; or where rounding hides what they bring.

    Args:
        rtol: distance from the minimum at which it ends, in standard errors.
        max_steps: most iterations.
        memory: number of past steps that the approximation of the Hessian is made of.
        line_search: most simulations of a line search.
    """

    rtol: Annotated[Scalar, positive] = eqx.field(converter=as_floats, default=1e-3)
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=200)
    memory: Annotated[int, whole(1)] = eqx.field(static=True, default=20)
    line_search: Annotated[int, whole(1)] = eqx.field(static=True, default=20)

    def begin(self, problem: FitProblem, z: Coordinates) -> "LBFGSState":
        no, zero, none = jnp.asarray(False), jnp.zeros((), z.dtype), jnp.zeros((), jnp.int32)
        past: Any = optax.scale_by_lbfgs(self.memory).init(z)
        return LBFGSState(z, no, zero, jnp.zeros_like(z), past, zero + jnp.inf, zero, none, no)

    def iterate(self, problem: FitProblem, state: "LBFGSState") -> tuple["LBFGSState", Evaluation]:
        def start(state: LBFGSState) -> LBFGSState:
            _, cost, gradient = problem.gradient(state.z)
            return state._replace(begun=~state.begun, cost=cost, gradient=gradient)

        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers
            state = jax.lax.cond(state.begun, partial(self._search, problem), start, state)
        return state, Evaluation(state.cost, state.gradient)

    def has_converged(self, state: "LBFGSState", seen: Evaluation) -> bool:
        return bool((state.small > 1) | (state.stalled & (state.predicted_decrease <= state.decrease_tolerance)))

    def _search(self, problem: FitProblem, state: "LBFGSState") -> "LBFGSState":
        """A line search along the quasi-Newton direction, or where nothing is known yet along the negative gradient."""
        z, cost, gradient = state.z, state.cost, state.gradient
        quasi_newton: Any = optax.scale_by_lbfgs(self.memory)
        fresh = quasi_newton.init(z)
        newton, steepest = (quasi_newton.update(gradient, past, z) for past in (state.past, fresh))
        steep = (state.past.count == 0) | (gradient @ newton[0] <= 0)
        along, past = _where(steep, steepest, newton)
        predicted_decrease = jnp.where(steep, jnp.minimum(state.predicted_decrease, gradient @ along), gradient @ along)
        # The part of the cost that may be rounding: each residual has that of the data, ε √Σ (data/σ)².
        rounding = problem.rounding_of_data().astype(cost.dtype)
        slack = jnp.sqrt(2 * cost) * rounding + rounding**2 + float(jnp.finfo(cost.dtype).eps) * cost

        def evaluate(z: Coordinates) -> tuple[Array, Coordinates]:
            """The cost and its derivative; infinite where either fails."""
            _, cost, gradient = problem.gradient(z)
            usable = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
            return jnp.where(usable, cost, jnp.inf), jnp.where(usable, gradient, 0)

        @jax.custom_jvp  # by which value and derivative are evaluated together, once
        def value(z: Coordinates) -> Array:
            return evaluate(z)[0]

        @value.defjvp
        def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
            at, derivative = evaluate(primals[0])
            return at, derivative @ tangents[0]

        line: Any = optax.scale_by_zoom_linesearch(self.line_search, approx_dec_rtol=slack / jnp.maximum(cost, slack))
        step, at_end = line.update(-along, line.init(z), z, value=cost, grad=gradient, value_fn=value)
        moved = (at_end.learning_rate > 0) & (at_end.value <= cost + slack)
        points = sum((jnp.isfinite(o.data).sum() for o in problem.observations), jnp.zeros((), int))
        freedom = jnp.maximum(points + problem.fixed_by_priors - problem.size, 1).astype(cost.dtype)
        decrease_tolerance = jnp.maximum(jnp.asarray(self.rtol, z.dtype) ** 2 * (2 * cost / freedom), slack)
        small = moved & (predicted_decrease <= decrease_tolerance) & (cost - at_end.value <= decrease_tolerance)
        after = LBFGSState(
            z=z + step,
            begun=state.begun,
            cost=at_end.value,
            gradient=at_end.grad,
            past=past,
            predicted_decrease=jnp.where(moved & ~small, jnp.inf, predicted_decrease),
            decrease_tolerance=decrease_tolerance,
            small=jnp.where(small, state.small + 1, 0),
            stalled=~moved & steep,
        )
        return _where(moved, after, after._replace(z=z, cost=cost, gradient=gradient, past=fresh))


class LBFGSState(NamedTuple):
    """State of L-BFGS."""

    z: Coordinates  # where it is
    begun: Bool[Array, ""]  # whether the cost is known where it is
    cost: Float[Array, ""]
    gradient: Coordinates
    past: optax.ScaleByLBFGSState  # past steps and the changes of the gradient in them
    predicted_decrease: Float[Array, ""]  # of the cost, by the gradient, for the last line search that lowered nothing
    decrease_tolerance: Float[Array, ""]  # decrease of the cost below which a line search is negligible
    small: Int[Array, ""]  # how many line searches in a row brought next to nothing
    stalled: Bool[Array, ""]  # whether nothing lower was found along the negative gradient


class Adam(AbstractOptimiser):
    """The Adam method of optax on gradients by reverse mode: for costs that are rough, where a line search is caught.

    An iteration is one simulation with its gradient. Where that fails, or `patience` iterations in a row find nothing
    lower, it begins anew at the best place, its steps half as long, and ends where these are shorter than `atol`.

    Args:
        learning_rate: length of a step in each coordinate [-], 0.05 for five per cent of a `Positive` parameter, or a
            schedule of it, a function of the number of the iteration such as those of optax.
        atol: length of the steps at which it ends [-].
        max_steps: most iterations.
        patience: iterations in a row without a lower cost, after which steps are halved.
    """

    learning_rate: Scalar | Callable[[Any], Any] = eqx.field(converter=as_floats, default=0.05)
    atol: Annotated[Scalar, positive] = eqx.field(converter=as_floats, default=1e-4)
    max_steps: Annotated[int, whole(1)] = eqx.field(static=True, default=500)
    patience: Annotated[int, whole(1)] = eqx.field(static=True, default=10)

    def __check_init__(self):
        require_fields(self)
        require_positive("Adam's learning_rate", self.rate(0))

    def rate(self, number: Any) -> Any:
        """The learning rate of an iteration, before any halving."""
        return self.learning_rate(number) if callable(self.learning_rate) else self.learning_rate

    def begin(self, problem: FitProblem, z: Coordinates) -> "AdamState":
        one, zero, rate = jnp.ones((), z.dtype), jnp.zeros((), jnp.int32), jnp.asarray(self.rate(0), z.dtype)
        return AdamState(z, zero, z, _MOMENTS.init(z), one * jnp.inf, jnp.zeros_like(z), one, rate, zero)

    def iterate(self, problem: FitProblem, state: "AdamState") -> tuple["AdamState", Evaluation]:
        _, cost, gradient = problem.gradient(state.trial)
        first = state.number == 0
        usable = jnp.isfinite(cost) & jnp.isfinite(gradient).all()
        lower = usable & (cost < state.cost)
        fruitless = jnp.where(lower, 0, state.fruitless + 1)
        back = ~usable | (fruitless >= self.patience)
        z, best, slope = _where(lower | first, (state.trial, cost, gradient), (state.z, state.cost, state.gradient))

        anew = z, slope, _MOMENTS.init(z)
        start, from_here, moments = _where(back, anew, (state.trial, gradient, state.moments))
        with jax.numpy_dtype_promotion("standard"):  # optax mixes integers and floats
            direction, moments = _MOMENTS.update(from_here, moments)
        factor = jnp.where(back, state.factor / 2, state.factor)
        step = factor * jnp.asarray(self.rate(state.number), z.dtype)
        after = AdamState(
            z=z,
            number=state.number + 1,
            trial=start - step * direction,
            moments=moments,
            cost=best,
            gradient=slope,
            factor=factor,
            step=step,
            fruitless=jnp.where(back, 0, fruitless),
        )
        return after, Evaluation(best, slope)

    def has_converged(self, state: "AdamState", seen: Evaluation) -> bool:
        return bool(state.step < self.atol)


class AdamState(NamedTuple):
    """State of Adam."""

    z: Coordinates  # where it is, the best place
    number: Int[Array, ""]  # how many simulations there were
    trial: Coordinates  # where the next one is
    moments: optax.ScaleByAdamState  # means of gradients and of their squares
    cost: Float[Array, ""]  # the lowest cost, that where it is
    gradient: Coordinates
    factor: Float[Array, ""]  # by what the learning rate is multiplied
    step: Float[Array, ""]  # length of the next step [-]
    fruitless: Int[Array, ""]  # how many simulations in a row found nothing lower


_MOMENTS: Any = optax.scale_by_adam()


def _where(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    """One of two pytrees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


_LEAST_GAIN, _POOR_GAIN, _GOOD_GAIN = 0.01, 0.25, 0.99  # from which one step is taken, the next as long, reach grows
_LONGER, _SHORTER = 3.5, 4.0  # factors of the reach where a step was as foretold, and where it is refused
_REACHES = 1e-300, 1e300
_FAR = 100.0  # a step is short below so many tolerances
_REFUSED = 0.1  # part of the Gauss-Newton step below which a step is held back
_LATELY = 6  # iterations, half of them refused, that lead nowhere where a misfit is not smooth
_NOWHERE, _SLOW = 0.03, 0.1  # how far they move a coordinate [-], by what part of the variance they lower Σ r², at most
_LITTLE = 0.01  # part of the variance by which a step of a tenth of a standard error lowers Σ r²
_FURTHEST = 2.0  # longest step of a coordinate with a bound [-]
_LEAP = 9.0  # longest step to a bound [-]: to a ten-thousandth of the distance from it
_NEAR, _HIDDEN = 3.0, 20.0  # errors from a bound that are near it; how many times farther the other is if it hides
_NEGLIGIBLE = 1e-4  # a step of so many standard errors is none
_ROUNDINGS = 10  # rounding of Σ r², in ε: a smaller change of it cannot be told
