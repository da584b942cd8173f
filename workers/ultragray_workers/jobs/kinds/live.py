"""Learning while scanning: a recording becomes a scene that is served in versions, from its first frames on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray_workers.jobs.kinds.base import Specification


@dataclass(frozen=True)
class LiveJob(Specification):
    """A recording becomes a scene while its frames arrive, served in versions from the first frames on.

    When the recording is finished, it ends as a training of the preset `fast` does. Raises InvalidArgument.
    """

    recording: str = described("Name of a recording that is open; of a dataset: it is trained from as a whole.")
    scene: str = described("Name that the scene is served under, each version in the place of the one before.")
    version_every_s: float = described("Least time between two versions, s.", 1.0, low=0.1, high=3600.0)
    kind: Literal["live"] = kind_field("live")

    run_module = "ultragray_workers.jobs.kinds.live_run"
    has_checkpoints = True
    needs_dataset = "recording"
    takes_recordings = True
    makes_scene = "scene"
    serves_versions = True
