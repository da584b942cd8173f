"""Convex bodies thicker than the beam: the side that is met first is seen, and hides what lies behind it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ultragray.probe import FloatArray
from ultragray.tools.crossing import Crossing, ScanView, dot
from ultragray.tools.tool import Tool

_LAYERS = np.array([-1.2816, -0.5244, 0.0, 0.5244, 1.2816])  # σ: the middles of fifths of a Gaussian slice
_LEAST = 1e-9


class Span(NamedTuple):
    """The part of lines that lies within a body, all of one shape; none where they leave before they enter."""

    enters: FloatArray  # along the line
    leaves: FloatArray
    head_on: FloatArray  # cosine of the angle between the line and the normal of the side where it enters


SpanOf = Callable[[FloatArray, FloatArray], Span]
"""Of points of lines [..., 3] and their directions [..., 3], in the body's own axes."""


def overlap(one: Span, other: Span) -> Span:
    """The part of lines that lies within both of two bodies."""
    return Span(
        np.maximum(one.enters, other.enters),
        np.minimum(one.leaves, other.leaves),
        np.where(one.enters >= other.enters, one.head_on, other.head_on),
    )


def between_planes(places: FloatArray, steps: FloatArray, half: float) -> Span:  # [...] both
    """The part of lines within `half` of a plane: their places and steps are those across it."""
    steep = np.where(np.abs(steps) < _LEAST, _LEAST, steps)
    ends = (-half - places) / steep, (half - places) / steep
    return Span(np.minimum(*ends), np.maximum(*ends), np.abs(steps))


def within_radius(places: FloatArray, steps: FloatArray, radius: float) -> Span:  # [..., 2] both
    """The part of lines within `radius` of an axis: their places and steps are those across it."""
    a = np.maximum((steps**2).sum(axis=-1), _LEAST**2)
    b, c = (places * steps).sum(axis=-1), (places**2).sum(axis=-1) - radius**2
    hits = b**2 > a * c
    root = np.sqrt(np.where(hits, b**2 - a * c, 0.0))
    enters = (-b - root) / a
    met = places + enters[..., None] * steps
    leaves = np.where(hits, (-b + root) / a, -np.inf)
    return Span(enters, leaves, np.minimum(np.abs((met * steps).sum(axis=-1)) / radius, 1.0))


def crossing_of_solid(tool: Tool, view: ScanView, placed: FloatArray, span_of: SpanOf) -> Crossing:
    """Where lines meet a body, by five layers of the slice.

    `placed`: [4, 3] mm, its middle and the points 1 mm from there along its own axes.
    """
    seen = tool.seen_by(view, placed.tolist())  # [C, 4, 3]
    middle, axes = seen[:, 0], seen[:, 1:] - seen[:, :1]  # [C, 3], [C, 3, 3]: rows are its axes
    origins, along, _ = view.lines
    depth = dot(middle[:, None] - origins, along)  # [C, W]
    raised = _LAYERS[:, None, None] * view.slice_mm(depth)  # [K, C, W]
    starts = origins - middle[:, None] + raised[..., None] * np.array([0.0, 1.0, 0.0])  # [K, C, W, 3]
    turned = np.einsum("cij,wj->cwi", axes, along)  # [C, W, 3]
    places = np.einsum("cij,kcwj->kcwi", axes, starts)
    span = span_of(places, np.broadcast_to(turned, places.shape))
    face = view.probe.face_depth_mm
    enters = np.maximum(span.enters, face)
    is_met = span.leaves > enters
    enters, path = np.where(is_met, enters, face), np.where(is_met, span.leaves - enters, _LEAST)
    slant = np.sqrt(np.maximum(1.0 - span.head_on**2, 0.0))
    # By as much the side lies higher or lower half a line away.
    rise = 0.5 * view.spacing_mm(enters) * slant / np.maximum(span.head_on, _LEAST)
    rise = np.minimum(rise, path)
    return Crossing(
        cover=is_met / len(_LAYERS),
        first_mm=np.maximum(enters - rise, face),
        last_mm=enters + rise,
        filled_mm=np.maximum(path - rise, 0.0),
        own_first_mm=np.maximum(enters - rise, face),
        own_last_mm=np.maximum(enters + rise, enters + path),
        path_mm=path,
        slant=slant,
        stopped=tool.stopped(path),
    )
