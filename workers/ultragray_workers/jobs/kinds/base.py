"""The base of the kinds of jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import Self

from ultragray.contract import Family, described
from ultragray.errors import ExtraMissing
from ultragray.scene.info import SceneHeader
from ultragray_workers.jobs.demand import AUTO, MAX_MEMORY_GB, check_device, check_labels
from ultragray_workers.scene_names import check_scene_name, check_scene_reference

MAX_RUN_S = 31_536_000.0
TOPIC = "Worker"
PLUGINS = "ultragray.job_kinds"  # entry points: the work of kinds that other distributions bring

if TYPE_CHECKING:
    from ultragray.geometry.registration import Registration
    from ultragray_workers.jobs.progress import Outcome
    from ultragray_workers.jobs.worker.job_run import JobRun


@dataclass(frozen=True)
class Surroundings:
    """The surroundings of a job at its submission."""

    scene: SceneHeader | None  # the one that `needs_scene` names
    free_bytes: int | None  # room for what the job makes; None: not known
    max_image_side: int  # pixels


@dataclass(frozen=True)
class Specification(Family):
    """The task of a job, a member of this family for each kind of job, with all that is particular to the kind.

    Those who queue, run and remove jobs know no kinds: they ask here which fields name a dataset or a scene.
    """

    kind: str
    max_run_s: float | None = described(
        "Longest time that the job may run in all, s; then it fails, and a retry goes on. None: the service's longest.",
        None,
        above=0.0,
        high=MAX_RUN_S,
        kw_only=True,
    )
    device: str = described(
        "auto, cpu, cuda or cuda:N: what the worker must offer; auto: a GPU where it offers one, else its processor.",
        AUTO,
        topic=TOPIC,
        kw_only=True,
    )
    min_memory_gb: int | None = described(
        "Least memory of the device, 10^9 bytes; of cpu: of the host.",
        None,
        low=1,
        high=MAX_MEMORY_GB,
        topic=TOPIC,
        kw_only=True,
    )
    worker_labels: dict[str, str] = described(
        'Labels that the worker must have, such as {"site": "lab1"}.', factory=dict, topic=TOPIC, kw_only=True
    )
    # Its `run(job_run, specification)` does the work; None: that of an entry point of PLUGINS does.
    run_module: ClassVar[str | None] = None
    needs_dataset: ClassVar[str | None] = None  # field: the dataset stays while the job waits or runs
    needs_scene: ClassVar[str | None] = None  # field: the scene is kept for the job as it is at the submission
    needs_registration: ClassVar[str | None] = None  # field: it leads the poses of the job as it is at the submission
    has_checkpoints: ClassVar[bool] = False  # interrupted, it goes on from where it was; others begin anew
    makes_scene: ClassVar[str | None] = None  # field: the scene among the artifacts is served when the job succeeds

    def __post_init__(self) -> None:
        super().__post_init__()
        check_device(self.device)
        check_labels(self.worker_labels, "worker_labels")
        if self.needs_scene is not None:
            check_scene_reference(getattr(self, self.needs_scene), self.needs_scene)
        if self.makes_scene is not None:
            check_scene_name(getattr(self, self.makes_scene), self.makes_scene)

    def check(self, surroundings: Surroundings) -> None:
        """Raises what the job would fail with, as far as its submission can know."""

    def registered(self, registration: Registration) -> Self:
        """The job with its poses brought into its scene, which names no registration any more."""
        raise NotImplementedError

    @classmethod
    def is_in_shards(cls, document: Mapping[str, Any]) -> bool:
        """Whether a job of this JSON is a batch, whose shards many workers make, see `kinds.shards_run`."""
        return False

    def run(self, job_run: JobRun) -> Outcome:
        """Does the work; in the job's own process, for it imports torch."""
        module: Any = self.plugin().load() if self.run_module is None else import_module(self.run_module)
        outcome: Outcome = module.run(job_run, self)
        return outcome

    def plugin(self) -> EntryPoint:
        """The module that does the work of a kind that another distribution brings. Raises ExtraMissing."""
        for point in entry_points(group=PLUGINS, name=self.kind):
            return point
        raise ExtraMissing(
            f"jobs of the kind {self.kind} are done by the distribution ultragray-studies, which is not installed: "
            "pip install ultragray-studies",
            field="kind",
        )
