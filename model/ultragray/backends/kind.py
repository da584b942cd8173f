"""The meaning of a scene's raw parameters, which kernels are told once for all Gaussians."""

from __future__ import annotations

from typing import NamedTuple


class Kind(NamedTuple):
    """How intensities are activated, and whether Gaussians have weights instead of transmittances."""

    intensity: str  # of scene_info.INTENSITIES
    weighted: bool = False  # see `weighted.weighted_sums`

    def place(self, backend: str) -> str:
        """The name under which a scene keeps what a backend prepared of it."""
        return f"{backend}, weighted" if self.weighted else backend
