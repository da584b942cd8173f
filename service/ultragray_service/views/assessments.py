"""How much poses can be trusted, without rendering their frames."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from ultragray.confidence import Assessor, Extrapolation
from ultragray.contract import described
from ultragray.probe import FloatArray, Probe
from ultragray.scene_info import SceneHeader

from ..core.catalog import SceneCatalog


@dataclass(frozen=True)
class Assessments:
    """Of poses, in their order."""

    extrapolations: list[Extrapolation] = described("supported_share is null: only a rendered frame tells it.")


class Assessing:
    """Assesses the poses of one caller at a time, beside the event loop."""

    def __init__(self, catalog: SceneCatalog) -> None:
        self._catalog = catalog
        self._turn = asyncio.Lock()

    async def assess(self, scene: str, poses: FloatArray, probe: Probe | None) -> Assessments:  # [C, 4, 4] mm, exact
        """The extrapolation of each pose of a probe (None: the scene's own).

        Raises SceneNotFound, SceneFileInvalid, and InvalidProbe where no probe is known.
        """
        header = await self._catalog.header(scene)
        async with self._turn:
            return Assessments(await asyncio.to_thread(_assess, header, poses, probe))


def _assess(header: SceneHeader, poses: FloatArray, probe: Probe | None) -> list[Extrapolation]:
    return Assessor(header.info, header.training_poses).assess(poses, probe)
