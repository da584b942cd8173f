"""A comparison over several seeds: the mean of each score of a method, and how much it changes from seed to seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ultragray.learn.report.tables import METRICS
from ultragray_studies.comparison.result import Comparison

Spread = dict[str, tuple[float, float]]  # mean and standard deviation (divisor S − 1) by metric


def over_seeds(comparisons: Sequence[Comparison]) -> dict[str, Spread]:
    """The scores over two seeds or more of each method that failed with none of them, by its title."""
    titles = {one.name: one.title for one in comparisons[0].results}
    spreads: dict[str, Spread] = {}
    for name, title in titles.items():
        of_seeds = [comparison.measured.get(name) for comparison in comparisons]
        means = [one.mean.to_dict() for one in of_seeds if one is not None]
        if len(means) == len(comparisons):
            values = {metric.name: np.array([mean[metric.name] for mean in means]) for metric in METRICS}
            spreads[title] = {metric: (float(one.mean()), float(one.std(ddof=1))) for metric, one in values.items()}
    return spreads


def plot_seeds(spreads: dict[str, Spread]) -> str:
    """A panel a score: the mean of each method as a point, with its standard deviation over the seeds as a bar."""
    from ultragray.learn.report.plots import line_style, make_figure, svg

    figure, axes = make_figure(len(METRICS), (11.0, 1.6 + 0.5 * len(spreads)), columns=2)
    titles = list(spreads)
    for axis, metric in zip(axes, METRICS, strict=True):
        for place, title in enumerate(titles):
            mean, deviation = spreads[title][metric.name]
            axis.errorbar(mean, place, xerr=deviation, fmt="o", capsize=4, color=line_style(place)["color"])
        axis.set(xlabel=metric.heading, yticks=range(len(titles)), yticklabels=titles)
        axis.invert_yaxis()
    return svg(figure)


def seeds_document(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """A JSON object: the comparison of each seed, and the scores over all of them."""
    scores = {
        title: {metric: {"mean": mean, "std": deviation} for metric, (mean, deviation) in spread.items()}
        for title, spread in over_seeds(comparisons).items()
    }
    return {"seeds": [one.to_dict() for one in comparisons], "over_seeds": scores}
