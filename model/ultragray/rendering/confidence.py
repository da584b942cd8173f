"""What becomes known of a frame's confidence only as it is rendered: its support by Gaussians, its contact with skin.

Before it stands `ultragray.scene.confidence`, which needs the pose alone; `render_shown` calls it for each batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ultragray.geometry.probe import FloatArray
from ultragray.rendering.settings import Below, Resolved
from ultragray.scene.confidence import (
    SUPPORT_COVERAGE,
    Assessor,
    Extrapolation,
    is_confident,
)


class SupportWatch:
    """The confidence in frames while they are rendered, in the order of their poses: their support and their contact
    with the skin, and the pixels that are masked for want of support.
    """

    def __init__(self, assessor: Assessor, extrapolations: Sequence[Extrapolation], settings: Resolved) -> None:
        """`extrapolations`: of all poses, from the poses alone."""
        self._mask_below = settings.min_confidence if settings.below_min_confidence is Below.MASK else None
        self.masks = self._mask_below is not None  # pixels of frames with less
        self._assessor, self._extrapolations = assessor, extrapolations
        self._noted: list[Tensor | npt.NDArray[np.float32]] = []  # each [C]: shares that a GPU may be at work on
        self._shares: list[float] = []  # those before
        self._contacts: list[Mapping[str, FloatArray]] = []
        self._count = 0

    def look(self, coverage: Tensor, contact: Mapping[str, FloatArray]) -> Tensor | None:  # [C, H, W] -> [C, H, W]
        """A mask of the pixels of the next C poses that are to be black; None where none are.

        `contact`: those of CONTACT_FIGURES that were judged, [C] each.
        """
        self._contacts.append(contact)
        shares = supported_shares(coverage)
        self.note(shares)
        if self._mask_below is None:
            return None
        extrapolations = self._extrapolations[self._count - len(shares) : self._count]
        assessments = self._assessor.with_support(extrapolations, shares.tolist())
        masked = [not is_confident(one, self._mask_below) for one in assessments]
        if not any(masked):
            return None
        return torch.tensor(masked, device=coverage.device)[:, None, None] & (coverage < SUPPORT_COVERAGE)

    def note(self, shares: Tensor | npt.NDArray[np.float32]) -> None:  # [C]
        """Takes the shares of pixels with support of the next C poses."""
        self._count += len(shares)
        self._noted.append(shares)

    def completed(self, first: int, stop: int) -> list[Extrapolation]:
        """The extrapolations of some frames with what was seen of them; waits for a GPU to have rendered."""
        self._shares.extend(share for some in self._noted for share in some.tolist())
        self._noted.clear()
        extrapolations = self._assessor.with_support(self._extrapolations[first:stop], self._shares[first:stop])
        if not (self._contacts and self._contacts[0]):
            return extrapolations
        judged = {
            name: np.concatenate([one[name] for one in self._contacts])[first:stop].tolist()
            for name in self._contacts[0]
        }
        return [replace(one, **{name: judged[name][at] for name in judged}) for at, one in enumerate(extrapolations)]


def supported_shares(coverage: Tensor) -> Tensor:  # [C, H, W] -> [C]
    """The share of each frame's pixels that Gaussians support."""
    if coverage.is_cuda:
        return (coverage >= SUPPORT_COVERAGE).flatten(1).float().mean(dim=1)
    supported = coverage.numpy() >= SUPPORT_COVERAGE  # numpy: torch's threads would fight with the kernel's
    return torch.from_numpy(np.array([np.count_nonzero(frame) / frame.size for frame in supported], np.float32))
