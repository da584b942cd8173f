"""Settings of the environments. Free of torch and of gymnasium."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import Contract, described
from ultragray.errors import InvalidImageSize
from ultragray.image_size import MAX_IMAGE_SIDE
from ultragray.settings import Contact

_ROOM_MM, _ROOM_DEG = 10.0, 10.0  # beyond twice the farthest start


@dataclass(frozen=True, kw_only=True)
class StandardPlaneSettings(Contract):
    """Settings of the environment StandardPlane-v0. Raises InvalidArgument."""

    height: int = described("Depth samples.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    width: int = described("Scan lines.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    start_mm: float = described("An episode begins at most so far from the goal.", 15.0, low=0.0, high=1000.0)
    start_deg: float = described("And turned by at most so much.", 15.0, low=0.0, high=90.0)
    step_mm: float = described("Largest shift of an action along each axis.", 2.0, above=0.0, high=100.0)
    step_deg: float = described("Largest turn of an action about each axis.", 2.0, above=0.0, high=45.0)
    reached_mm: float = described("So near to the goal, an episode ends.", 1.0, low=0.0, high=100.0)
    reached_deg: float = described("And turned from it by at most so much.", 2.0, low=0.0, high=90.0)
    contact: Contact | None = described(
        "air: scan lines whose face is off the skin are dark. pressure: and a face that is pressed in compresses the "
        "tissue. None: contact is assumed.",
        Contact.AIR,
    )
    with_pose: bool = described("Observe the pose beside the frame.", False)

    @property
    def reach_mm(self) -> float:
        """The farthest that the probe gets from the goal."""
        return 2.0 * self.start_mm + _ROOM_MM

    @property
    def reach_deg(self) -> float:
        """The most that it can be turned from the goal."""
        return min(2.0 * self.start_deg + _ROOM_DEG, 180.0)
