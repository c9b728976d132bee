"""The picture of a fit, and its numbers."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from mpmjax.fitting import Experiment, FitResult, RefinedFit
from mpmjax.io import replacing, save_figure

_MOST_LINES = 6
"""Components of an observation that are drawn."""


def draw_fit(result: FitResult, path: Path, measured: tuple[Experiment, ...] = ()) -> Path:
    """Data and fitted simulation, residuals in units of the noise, and the misfit of each iteration.

    Args:
        result: the fit.
        path: the picture.
        measured: the fitted experiments with more data, or longer: the fit predicts what it was not given.
    """
    from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

    shown = measured or result.experiments
    panels = []
    for fitted, whole in zip(result.experiments, shown, strict=True):
        now = fitted.with_observations(whole.observations, whole.t1)
        panels += zip(whole.observations, now.predictions(now.run(throw=False)), fitted.observations, strict=True)
    rows = len(panels) + 1
    figure, axes = plt.subplots(rows, 2, figsize=(9.6, 3.2 * rows), layout="constrained", squeeze=False)
    for (left, right), (observation, predicted, fitted), noise in zip(axes, panels, result.noise, strict=False):
        name, x = observation.against
        order, sigma = np.argsort(x), noise.sigma if observation.sigma is None else np.asarray(observation.sigma)
        arrays = observation.data, predicted, np.broadcast_to(sigma, observation.data.shape)
        data, model, sigma = (np.asarray(a, float).reshape(len(x), -1)[order] for a in arrays)
        x = x[order]
        for k in range(min(data.shape[1], _MOST_LINES)):
            left.plot(x, model[:, k], color=f"C{k}", linewidth=1.2)
            left.plot(x, data[:, k], "o", color=f"C{k}", markersize=3)
        right.axhspan(-2, 2, color="0.93")
        right.plot(x, (model - data) / sigma, ".", color="0.3", markersize=3)
        last = float(fitted.against[1].max())
        if x.max() > last:
            for axis in (left, right):
                axis.axvline(last, color="0.6", linewidth=0.8, linestyle="--")
            left.set_title("fitted to the dashed line, predicted beyond", fontsize=9)
        left.set(xlabel=name, ylabel=observation.name)
        right.set(xlabel=name, ylabel="(simulated − measured) / σ")
    cost, text = axes[-1]
    last = max(i for i, iteration in enumerate(result.history) if iteration.number == 0)
    cost.semilogy([2 * iteration.cost for iteration in result.history[last:]], "o-", markersize=3)
    cost.set(xlabel="iteration", ylabel="Σ r²", title="the last search")
    text.axis("off")
    lines = [f"{e.label} = {e.value:.5g} ± {e.error:.2g} {e.unit}" for e in (*result.estimates, *result.reported)]
    text.text(0, 1, "\n".join([*lines, *result.warnings]), va="top", fontsize=9, wrap=True)
    save_figure(figure, path, 140)
    plt.close(figure)
    return path


def write_fit(found: FitResult | RefinedFit, path: Path) -> Path:
    """The numbers of a fit as JSON: estimates with errors and intervals, correlations, noise, χ² and iterations. Of a
    fit on several grids, the extrapolated estimates, and those numbers of each grid."""
    if isinstance(found, RefinedFit):
        numbers: dict[str, Any] = {
            "estimates": [e._asdict() for e in found.estimates],
            "error_from_noise": found.from_noise,
            "error_from_discretisation": found.from_discretisation,
            "order": found.order,
            "refinements": found.refinements,
            "fits": [_numbers(each) for each in found.fits],
        }
    else:
        numbers = _numbers(found)
    with replacing(path) as aside:
        aside.write_text(json.dumps(_plain(numbers), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _numbers(result: FitResult) -> dict[str, Any]:
    return {
        "estimates": [e._asdict() for e in (*result.estimates, *result.reported)],
        "correlation": result.correlation,
        "fisher_spectrum": result.spectrum,
        "covariance_of_coordinates": result.covariance,
        "fisher_directions": result.directions,
        "chi_squared": result.chi_squared,
        "p_value": result.p_value,
        "degrees_of_freedom": result.degrees_of_freedom,
        "level": result.level,
        "noise": [n._asdict() for n in result.noise],
        "converged": result.converged,
        "iterations": [i._asdict() for i in result.history],
        "interrupted": result.interrupted,
        "warnings": result.warnings,
    }


def _plain(value: object) -> object:
    """As JSON has it: arrays as lists, what is not finite as null."""
    match value:
        case dict():
            return {key: _plain(v) for key, v in value.items()}
        case list() | tuple() | np.ndarray():
            return [_plain(v) for v in value]
        case bool() | np.bool_():
            return bool(value)
        case float() | np.floating():
            return float(value) if np.isfinite(value) else None
        case np.integer():
            return int(value)
        case _:
            return value
