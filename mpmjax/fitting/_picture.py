"""The picture of an observation."""

import itertools
from typing import Any

import numpy as np

from mpmjax.fitting._experiment import AbstractObservation, Shown
from mpmjax.fitting._uncertainty import Prediction

_MOST_LINES = 6  # components of an observation that are drawn


def measured_components(observation: AbstractObservation) -> list[tuple[int, str]]:
    """Numbers and names of the components, in C order, of which anything was measured."""
    shown, shape = getattr(observation, "shown", Shown()), observation.data.shape[1:]
    measured = np.isfinite(observation.data.reshape(len(observation.data), -1)).any(axis=0)
    names = [list(map(str, range(n))) for n in shape]
    if shape and shape[-1] <= 3:
        names[-1] = list("xyz"[: shape[-1]])
    labels = shown.columns or tuple(", ".join(of) for of in itertools.product(*names))
    return [(k, labels[k]) for k in np.flatnonzero(measured).tolist()]


def draw_observation(axis: Any, observation: AbstractObservation, predicted: Prediction, last: float) -> None:
    """Data, fit and bands in the data's units; the data that were fitted end at `last`."""
    shown: Shown = getattr(observation, "shown", Shown())
    name, against = observation.against
    order = np.argsort(against)
    x = shown.along(against[order])

    def columns(of: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(of, float), predicted.value.shape).reshape(len(x), -1)[order] / shown.unit

    data, model, lower, upper = map(columns, (observation.data, predicted.value, predicted.lower, predicted.upper))
    components, level = measured_components(observation), f"{100 * predicted.level:g} %"
    says = {"measured": "measured", "fit": "fit", "mean": f"{level} of the mean", "new": f"{level} of new measurements"}
    if len(components) > 1:  # a colour for each component, by its name, and grey for the rest
        axis.plot([], [], "o", color="0.4", markersize=3.5, label=says["measured"])
        axis.plot([], [], color="0.4", linewidth=1.2, label=says["fit"])
        axis.fill_between([], [], [], color="0.4", alpha=0.35, linewidth=0, label=says["mean"])
        says = {}
    for number, (k, label) in enumerate(components[:_MOST_LINES]):
        band: dict[str, Any] = {"color": f"C{number}", "linewidth": 0}
        if predicted.new_lower is not None:
            new = columns(predicted.new_lower)[:, k], columns(predicted.new_upper)[:, k]
            axis.fill_between(x, *new, alpha=0.12, label=says.get("new"), **band)
        axis.fill_between(x, lower[:, k], upper[:, k], alpha=0.35, label=says.get("mean"), **band)
        axis.plot(x, model[:, k], color=f"C{number}", linewidth=1.2, label=says.get("fit"))
        dots: dict[str, Any] = {"markersize": 3.5, "markeredgecolor": "white", "markeredgewidth": 0.5}
        axis.plot(x, data[:, k], "o", color=f"C{number}", label=says.get("measured", label), **dots)
    more = len(components) - _MOST_LINES
    axis.legend(fontsize=7, frameon=False, title=f"{_MOST_LINES} of {len(components)} shown" if more > 0 else None)
    if against.max() > last:
        axis.axvline(float(shown.along(np.array([last]))[0]), color="0.6", linewidth=0.8, linestyle="--")
        axis.set_title("fitted to the dashed line, predicted beyond", fontsize=9)
    axis.set(xlabel=shown.x or name, ylabel=shown.y or observation.name)
    axis.spines[["top", "right"]].set_visible(False)
