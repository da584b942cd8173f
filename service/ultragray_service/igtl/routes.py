"""From the name of a device to the scene of its poses and to the name of its images."""

from __future__ import annotations

import re
import time

from ultragray.contract import shown
from ultragray_service.core.scenes import SceneCatalog
from ultragray_service.igtl.messages import DEVICE_NAME_BYTES, pack_text
from ultragray_workers.errors import SceneNotFound

_FRAME = re.compile(r".+To(?=[A-Z0-9])(?P<frame>.+)|.+?To(?P<other>.+)")  # of PLUS: ProbeToReference
_NAMES_LIVE_S = 1.0


def frame_of(device_name: str) -> str:
    """The frame that a device's poses lead to: Reference of ProbeToReference; else the device's own name."""
    match = _FRAME.fullmatch(device_name)
    return (match["frame"] or match["other"]) if match else device_name


def image_name(device_name: str) -> str:
    """The name of the images of a device: Image_Reference for ProbeToReference, as PLUS calls them."""
    return pack_text(f"Image_{frame_of(device_name)}", DEVICE_NAME_BYTES).decode()


def device_of(scene: str) -> str:
    """A device name whose poses are of a scene: ProbeToliver; ProbeToReference, of the default scene, for a name that
    is too long."""
    for name in (f"ProbeTo{scene}", scene):
        if len(name.encode()) <= DEVICE_NAME_BYTES and scene in (name, frame_of(name)):
            return name
    return "ProbeToReference"


class SceneChooser:
    """Chooses scenes by the names of devices; knows the scenes as they were at most a second ago."""

    def __init__(self, catalog: SceneCatalog, default: str | None) -> None:
        self._catalog, self._default = catalog, default
        self._names: list[str] = []
        self._read_at = -_NAMES_LIVE_S

    async def named(self, device_name: str) -> str | None:
        names = await self._known()
        return next((name for name in (device_name, frame_of(device_name)) if name in names), None)

    async def prefer(self, scene: str) -> None:
        if scene not in await self._known():
            raise SceneNotFound(f"there is no scene {shown(scene)}", field="scene")
        self._default = scene

    async def choose(self, device_name: str) -> str:
        """The scene that the device names, else the default, else the only one. Raises SceneNotFound."""
        if scene := await self.named(device_name) or self._default:
            return scene
        names = await self._known()
        if len(names) != 1:
            raise SceneNotFound(
                f"device {device_name!r} names none of the {len(names)} scenes; name the device like a scene or "
                f"SomethingToSCENE, or set ULTRAGRAY_IGTL_SCENE",
                field="scene",
            )
        return names[0]

    async def _known(self) -> list[str]:
        if time.monotonic() - self._read_at >= _NAMES_LIVE_S:
            self._read_at = time.monotonic()
            self._names = await self._catalog.names()
        return self._names
