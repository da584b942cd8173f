"""How much poses can be trusted, without rendering their frames."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from ultragray.contract import described
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.scene.confidence import Assessor, Extrapolation
from ultragray.scene.info import SceneHeader
from ultragray_service.core.registrations import Registrations
from ultragray_service.core.scenes import SceneCatalog


@dataclass(frozen=True)
class Assessments:
    """Of poses, in their order."""

    extrapolations: list[Extrapolation] = described("supported_share is null: only a rendered frame tells it.")


class Assessing:
    """Assesses the poses of one caller at a time, beside the event loop."""

    def __init__(self, catalog: SceneCatalog, registrations: Registrations) -> None:
        self._catalog, self._registrations = catalog, registrations
        self._turn = asyncio.Lock()

    async def assess(
        self,
        scene: str,
        poses: FloatArray,  # [C, 4, 4] mm, exact
        probe: Probe | None,
        registration: str | None,
    ) -> Assessments:
        """The extrapolation of each pose of a probe (None: the scene's own), led into the scene by a registration.

        Raises SceneNotFound, SceneFileInvalid, RegistrationNotFound, and InvalidProbe where no probe is known.
        """
        header = await self._catalog.header(scene)
        if registration is not None:
            poses = (await self._registrations.of_scene(registration, scene)).probe_to_scene(poses)
        async with self._turn:
            return Assessments(await asyncio.to_thread(_assess, header, poses, probe))


def _assess(header: SceneHeader, poses: FloatArray, probe: Probe | None) -> list[Extrapolation]:
    return Assessor(header.info, header.training_poses).assess(poses, probe)
