"""Support by Gaussians while frames are rendered: its share of each frame, and masks of the pixels that have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ultragray.confidence.assess import SUPPORT_COVERAGE, Assessor, Extrapolation
from ultragray.contact.touch import Touch
from ultragray.probe import FloatArray


class SupportWatch:
    """Records the support and the contact of frames as they are rendered, in the order of their poses."""

    def __init__(self, masked: Sequence[bool]) -> None:
        """`masked`: for each pose, whether pixels without support are to be black."""
        self._masked = masked
        self._shares: list[Tensor] = []
        self._contacts: list[FloatArray] = []
        self._count = 0

    def look(self, coverage: Tensor, touch: Touch | None = None) -> Tensor | None:  # [C, H, W] -> [C, H, W]
        """A mask of the pixels of the next C poses that are to be black; None where none are."""
        if touch is not None:
            self._contacts.append(touch.shares)
        masked = self._masked[self._count : self._count + len(coverage)]
        self._count += len(coverage)
        self._shares.append(_supported_shares(coverage))
        if not any(masked):
            return None
        return torch.tensor(masked, device=coverage.device)[:, None, None] & (coverage < SUPPORT_COVERAGE)

    def shares(self, first: int, count: int) -> list[float]:
        """The share of each of `count` frames that has support, from `first` on; waits for a GPU to have rendered."""
        shares: list[float] = torch.cat(self._shares)[first : first + count].tolist()
        return shares

    def completed(
        self, assessor: Assessor, extrapolations: Sequence[Extrapolation], first: int
    ) -> list[Extrapolation]:  # [B]
        """The extrapolations of the frames from `first` on, with what was seen of their support and contact."""
        found = assessor.with_support(extrapolations, self.shares(first, len(extrapolations)))
        if not self._contacts:
            return found
        contacts = np.concatenate(self._contacts)[first:].tolist()
        return [replace(one, contact_share=contact) for one, contact in zip(found, contacts, strict=False)]


def _supported_shares(coverage: Tensor) -> Tensor:  # [C, H, W] -> [C]
    if coverage.is_cuda:
        return (coverage >= SUPPORT_COVERAGE).flatten(1).float().mean(dim=1)
    supported = coverage.numpy() >= SUPPORT_COVERAGE  # numpy: torch's threads would fight with the kernel's
    return torch.tensor([np.count_nonzero(frame) / frame.size for frame in supported])
