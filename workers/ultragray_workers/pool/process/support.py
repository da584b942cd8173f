"""Poses whose confidence is below the limit of a render job."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.confidence import Extrapolation, is_confident, low_confidence
from ultragray.errors import LowConfidence

from ..messages import RenderJob
from ..types import Below


def below_limit(job: RenderJob, extrapolations: Sequence[Extrapolation]) -> list[bool]:
    """Which poses have less confidence than the job wants; a scene without a model has none."""
    limit = job.trust.min_confidence
    return [limit is not None and not is_confident(told, limit) for told in extrapolations]


def refusal(job: RenderJob, extrapolations: Sequence[Extrapolation]) -> LowConfidence | None:
    """Why a job of one part is not rendered; None where it is."""
    limit = job.trust.min_confidence
    if limit is None or job.trust.below is not Below.REFUSE:
        return None
    for index, told in enumerate(extrapolations):
        if not is_confident(told, limit):
            part = job.parts[0]
            return low_confidence(told, limit, "pose" if part.total == 1 else f"poses[{part.first + index}]")
    return None
