"""Poses whose confidence is below the limit of a render job."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.confidence import Extrapolation, is_confident, low_confidence
from ultragray.errors import LowConfidence
from ultragray.settings import Below
from ultragray_workers.pool.messages import RenderTask


def below_limit(task: RenderTask, extrapolations: Sequence[Extrapolation]) -> list[bool]:
    """For each pose, whether it has less confidence than the task wants; a scene without a model has none."""
    limit = task.view.min_confidence
    return [limit is not None and not is_confident(one, limit) for one in extrapolations]


def refusal(task: RenderTask, extrapolations: Sequence[Extrapolation]) -> LowConfidence | None:
    """The reason not to render a task of one part; None where it is rendered."""
    limit = task.view.min_confidence
    if limit is None or task.view.below_min_confidence is not Below.REFUSE:
        return None
    for index, one in enumerate(extrapolations):
        if not is_confident(one, limit):
            return low_confidence(one, limit, task.parts[0].name_pose(index))
    return None
