"""Support by Gaussians while frames are rendered: how much of each frame has it, and frames without what has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ultragray.confidence import SUPPORT_COVERAGE, Extrapolation, is_confident, low_confidence
from ultragray.errors import LowConfidence

from ..messages import RenderJob
from ..types import Below


class SupportWatch:
    """Looks at the coverage of frames as they are rendered, in the order of their poses."""

    def __init__(self, masked: Sequence[bool]) -> None:
        """`masked` tells for each pose whether pixels without support are to be black."""
        self._masked = masked
        self._shares: list[Tensor] = []
        self._count = 0

    def look(self, coverage: Tensor) -> Tensor | None:  # [C, H, W] -> [C, H, W]
        """Which pixels of the next C poses are to be black; None where none are."""
        masked = self._masked[self._count : self._count + len(coverage)]
        self._count += len(coverage)
        self._shares.append(_supported_shares(coverage))
        if not any(masked):
            return None
        return torch.tensor(masked, device=coverage.device)[:, None, None] & (coverage < SUPPORT_COVERAGE)

    def told(self, extrapolations: Sequence[Extrapolation], first: int) -> tuple[Extrapolation, ...]:
        """Those of the poses from `first` on, with their shares; waits for a GPU to have rendered them."""
        return _with_shares(extrapolations, torch.cat(self._shares)[first : first + len(extrapolations)])


def with_support(extrapolations: Sequence[Extrapolation], coverage: Tensor) -> tuple[Extrapolation, ...]:
    """Those of C poses with the share of the pixels that Gaussians support in their `coverage` [C, H, W]."""
    return _with_shares(extrapolations, _supported_shares(coverage))


def _with_shares(extrapolations: Sequence[Extrapolation], shares: Tensor) -> tuple[Extrapolation, ...]:  # [C]
    told = zip(extrapolations, shares.tolist(), strict=True)
    return tuple(replace(one, supported_share=share) for one, share in told)


def _supported_shares(coverage: Tensor) -> Tensor:  # [C, H, W] -> [C]
    if coverage.is_cuda:
        return (coverage >= SUPPORT_COVERAGE).flatten(1).float().mean(dim=1)
    supported = coverage.numpy() >= SUPPORT_COVERAGE  # numpy: torch's threads would fight with the kernel's
    return torch.tensor([np.count_nonzero(frame) / frame.size for frame in supported])


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
