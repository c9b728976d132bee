"""Charts: of a fit, with its numbers as JSON, and of error against seconds, with its numbers as CSV."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from mpmjax.analysis import WorkPrecision, name_of
from mpmjax.fitting import (
    AbstractObservation,
    Experiment,
    FitResult,
    Prediction,
    Profile,
    RefinedFit,
    predict_observations,
)
from mpmjax.io import replacing, save_figure

Experiments = tuple[Experiment, ...]


def draw_chart(comparison: WorkPrecision, path: Path) -> Path:
    """Error over seconds, a line for each method and grid.

    Runs that failed and runs that were only foreseen stand at the upper edge; the error that was asked for is a line,
    and below the reference run's own error nothing is certain.
    """
    from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

    figure, axes = plt.subplots(figsize=(7.2, 4.8), layout="constrained")
    lines = list(dict.fromkeys((name_of(t.method), t.refinement) for t in comparison.trials))
    names = list(dict.fromkeys(name for name, _ in lines))
    top = 2 * max((t.error for t in comparison.trials if np.isfinite(t.error)), default=1.0)
    for name, refinement in lines:
        trials = [t for t in comparison.trials if (name_of(t.method), t.refinement) == (name, refinement)]
        colour, dashes = f"C{names.index(name)}", "-" if refinement == 1 else "--"
        label = name if refinement == 1 else f"{name}, spacing / {refinement}"
        good = sorted((t.seconds, t.error) for t in trials if np.isfinite(t.error))
        seconds, errors = zip(*good, strict=True) if good else ((), ())
        axes.plot(seconds, errors, dashes, color=colour, marker="o", markersize=4, label=label)
        for mark, test in (("x", np.isinf), (">", np.isnan)):
            bad = [t.seconds for t in trials if test(t.error)]
            axes.plot(bad, [top] * len(bad), mark, color=colour)
    axes.axhline(comparison.target, color="black", linewidth=0.8)
    axes.axhspan(0, comparison.reference.error, color="0.92")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="relative error of the motion")
    axes.set_title("x failed, > foreseen; grey: less than the reference's own uncertainty", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    save_figure(figure, path, 140)
    plt.close(figure)
    return path


def write_trials(comparison: WorkPrecision, path: Path) -> Path:
    """The trials as CSV; an error of inf is a run that failed, of nan one that was foreseen to take too long."""
    with replacing(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["method", "refinement", "dt_s", "steps", "seconds", "error", "linearisation_error"])
        rows.writerows([name_of(t.method), *t[1:]] for t in comparison.trials)
    return path


_PROFILES_A_ROW = 3


def write_fit(
    outcome: FitResult | RefinedFit, picture: Path, measured: Experiments = (), profiles: tuple[Profile, ...] = ()
) -> Path:
    """Write the picture of a fit, and beside it its numbers as JSON, the path of which is returned.

    The picture has data, the fitted simulation and its bands, residuals in units of the noise, the misfit of each
    iteration, and profiles; the numbers are estimates with errors and intervals, correlations, noise, χ², iterations,
    predictions with bands, and profiles. Numbers that are not finite are null. Of a fit on several grids there are the
    extrapolated estimates and those numbers of each grid; picture and profiles are of the finest, as `measured`: the
    fitted experiments with more data, or longer, which the fit predicts.
    """
    *coarser, result = outcome.fits if isinstance(outcome, RefinedFit) else (outcome,)
    measured = measured or result.experiments
    predictions = predict_observations(result, measured)
    _draw(result, picture, measured, profiles, predictions)
    numbers = _numbers(result, measured, profiles, predictions)
    if isinstance(outcome, RefinedFit):
        before = [_numbers(each, each.experiments, (), predict_observations(each)) for each in coarser]
        numbers = {
            "estimates": [e._asdict() for e in outcome.estimates],
            "error_from_noise": outcome.from_noise,
            "error_from_discretisation": outcome.from_discretisation,
            "order": outcome.order,
            "refinements": outcome.refinements,
            "fits": [*before, numbers],
        }
    text = json.dumps(numbers, default=lambda array: array.tolist())
    plain = json.loads(text, parse_constant=lambda not_finite: None)
    path = picture.with_suffix(".json")
    with replacing(path) as aside:
        aside.write_text(json.dumps(plain, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _draw(
    result: FitResult,
    path: Path,
    measured: Experiments,
    profiles: tuple[Profile, ...],
    predictions: tuple[Prediction, ...],
) -> None:
    """Draw the picture of `write_fit`."""
    from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

    observations = [o for e in measured for o in e.observations]
    fitted = [o for e in result.experiments for o in e.observations]
    rows = len(observations) + 1 + -(-len(profiles) // _PROFILES_A_ROW)
    heights = [3.0] * len(observations) + [2.6] * (rows - len(observations))
    figure = plt.figure(figsize=(9.6, sum(heights)), layout="constrained")
    grid = figure.add_gridspec(rows, 6, height_ratios=heights)
    panels = [figure.add_subplot(grid[row, :4]) for row in range(len(observations))]
    result.plot(panels, measured=measured, predictions=predictions)
    for row, (observation, predicted, used) in enumerate(zip(observations, predictions, fitted, strict=True)):
        _draw_residuals(figure.add_subplot(grid[row, 4:]), observation, predicted, float(used.against[1].max()))
    row = len(observations)
    axis: Any = figure.add_subplot(grid[row, :2])
    last = max(i for i, iteration in enumerate(result.history) if iteration.number == 0)
    axis.semilogy([2 * iteration.cost for iteration in result.history[last:]], "o-", color="0.3", markersize=3, lw=1)
    axis.set(xlabel="iteration" if last == 0 else "iteration of the last search", ylabel="Σ r²")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis = figure.add_subplot(grid[row, 2:])  # the estimates with their intervals, and warnings
    by_profile = {p.label: p.interval for p in profiles}
    wide = max(len(e.name) for e in result.all)
    lines = [f"{'':<{wide}}{'value':>12} ± {'error':<9}{100 * result.level:g} % interval"]
    for e in result.all:
        lower, upper = by_profile.get(e.label, e.interval)
        profiled = (" by profile" if e.label in by_profile else "") + (", at its bound" if e.at_bound else "")
        lines.append(f"{e.name:<{wide}}{e.value:>12.5g} ± {e.error:<9.2g}{lower:.5g} to {upper:.5g}{profiled}")
    lines += ["", f"χ² = {result.chi_squared:.4g}, {result.degrees_of_freedom} degrees of freedom"]
    axis.axis("off")
    axis.text(0, 1, "\n".join(lines), va="top", fontsize=7.5, family="monospace", transform=axis.transAxes)
    texts = [*result.warnings, *(text for p in profiles for text in p.warnings)]
    axis.text(0, 0, "\n".join(texts), va="bottom", fontsize=7, wrap=True, color="C3", transform=axis.transAxes)
    for number, profile in enumerate(profiles):
        below, along = divmod(number, _PROFILES_A_ROW)
        _draw_profile(figure.add_subplot(grid[row + 1 + below, 2 * along : 2 * along + 2]), profile)
    for axis in figure.axes:
        axis.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, 140)
    plt.close(figure)


def _draw_residuals(axis: Any, observation: AbstractObservation, predicted: Prediction, last: float) -> None:
    """Residuals of the components that were measured, in units of the noise; those fitted end at `last`."""
    shown, (name, against) = observation.shown, observation.against
    x = shown.along(against)
    if predicted.sigma is not None:
        axis.axhspan(-2, 2, color="0.93", linewidth=0)
        axis.axhline(0, color="0.7", linewidth=0.8)
        r = ((predicted.value - observation.data) / predicted.sigma).reshape(len(x), -1)
        for number, (k, _) in enumerate(observation.components):
            axis.plot(x, r[:, k], ".", color=f"C{number}", markersize=4)
    if against.max() > last:
        axis.axvline(float(shown.along(np.array([last]))[0]), color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xlabel=shown.x or name, ylabel="(fit − measured) / σ")


def _draw_profile(axis: Any, profile: Profile) -> None:
    """Δχ² over the parameter, its threshold, and the interval; dashed, the interval of the standard error."""
    from scipy.interpolate import PchipInterpolator

    values, threshold = profile.values, profile.threshold
    axis.axvspan(*np.clip(profile.interval, values[0], values[-1]), color="C0", alpha=0.12, linewidth=0)
    axis.axhline(threshold, color="0.5", linewidth=0.8, linestyle=":")
    fine = np.linspace(values[0], values[-1], 200)
    root = PchipInterpolator(values, profile.signed_root)(fine)
    axis.plot(fine, root**2, color="C0", linewidth=1.2, label="profile")
    axis.plot(values, profile.statistic, "o", color="C0", markersize=3)
    for end in profile.symmetric:
        if values[0] <= end <= values[-1]:
            axis.axvline(end, color="0.4", linewidth=1, linestyle="--")
    axis.plot([], [], "--", color="0.4", linewidth=1, label="by its standard error")
    unit = f" [{profile.unit}]" if profile.unit else ""
    axis.set(xlabel=f"{profile.label}{unit}", ylabel="Δχ²", ylim=(0, 1.5 * threshold))
    axis.legend(fontsize=7, frameon=False, loc="upper center")


def _numbers(
    result: FitResult, measured: Experiments, profiles: tuple[Profile, ...], predictions: tuple[Prediction, ...]
) -> dict[str, Any]:
    """The numbers of a fit on one grid, see `write_fit`."""
    plain = ("chi_squared", "p_value", "degrees_of_freedom", "level", "converged", "interrupted")
    bands = ("value", "error", "lower", "upper", "sigma", "new_lower", "new_upper")
    of_profile = ("label", "interval", "threshold", "degrees_of_freedom", "level", "warnings")
    return {
        "estimates": [e._asdict() for e in result.all],
        "correlation": result.uncertainty.correlation,
        "fisher_spectrum": result.uncertainty.spectrum,
        "covariance_of_coordinates": result.uncertainty.covariance,
        "fisher_directions": result.uncertainty.directions,
        **{name: getattr(result, name) for name in plain},
        "noise": [n._asdict() for n in result.noise],
        "predictions": [
            {"name": o.name, "against": o.against[0], "x": o.against[1], "measured": o.data}
            | {name: getattr(p, name) for name in bands}
            for o, p in zip((o for e in measured for o in e.observations), predictions, strict=True)
        ],
        "profiles": [
            {name: getattr(p, name) for name in of_profile}
            | {"symmetric_interval": p.symmetric, "delta_chi_squared": p.statistic}
            | {"numbers": {label: p.along(label) for label in p.labels}}
            for p in profiles
        ],
        "iterations": [i._asdict() for i in result.history],
        "warnings": result.warnings,
    }
