"""The base of the kinds of jobs: specifications, and their JSON, as the queue keeps it and HTTP takes it."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from typing_extensions import Self

from ultragray import contract
from ultragray.contract import Family, described
from ultragray.errors import ExtraMissing, InvalidArgument
from ultragray.geometry.probe import FloatArray
from ultragray.samplers import MAX_POSES
from ultragray.scene.info import SceneHeader
from ultragray.scene.shapes import OfFile
from ultragray_workers.jobs.demand import AUTO, MAX_MEMORY_GB, check_device, check_labels
from ultragray_workers.scene_names import check_scene_name, check_scene_reference

MAX_RUN_S = 31_536_000.0
TOPIC = "Worker"
_POSES, _POSE_COUNT = "poses", "pose_count"
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
    takes_recordings: ClassVar[bool] = False  # also a recording, which is no dataset yet
    needs_scene: ClassVar[str | None] = None  # field: the scene is kept for the job as it is at the submission
    needs_registration: ClassVar[str | None] = None  # field: it leads the poses of the job as it is at the submission
    carries: ClassVar[str | None] = None  # field: a file that comes with the job; it is kept for it, beside its row
    has_checkpoints: ClassVar[bool] = False  # interrupted, it goes on from where it was; others begin anew
    makes_scene: ClassVar[str | None] = None  # field: the scene among the artifacts is served when the job succeeds
    serves_versions: ClassVar[bool] = False  # it serves that scene while it runs, too, and keeps it whatever ends it

    def __post_init__(self) -> None:
        super().__post_init__()
        check_device(self.device)
        check_labels(self.worker_labels, "worker_labels")
        if self.needs_scene is not None and (scene := getattr(self, self.needs_scene)) is not None:
            check_scene_reference(scene, self.needs_scene)
        if self.makes_scene is not None:
            check_scene_name(getattr(self, self.makes_scene), self.makes_scene)

    def check(self, surroundings: Surroundings) -> None:
        """Raises what the job would fail with, as far as its submission can know."""

    @property
    def carried(self) -> OfFile | None:
        """The file that comes with the job."""
        return None if self.carries is None else getattr(self, self.carries)

    def carried_content(self) -> bytes:
        """Raises InvalidArgument."""
        assert self.carried is not None
        with contract.under(str(self.carries)):
            return self.carried.content()

    def check_carried(self, path: Path) -> None:
        """Raises what the job would fail with for that file."""

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


def to_dict(specification: Specification) -> dict[str, Any]:
    """The specification in JSON; `kind` comes first. Poses are base64 of float64, row by row, the low byte first.

    Of a file that it carries it tells the hash alone.
    """
    document, poses = _without_poses(specification)
    if poses is not None:
        document[_POSES] = base64.b64encode(poses.astype("<f8").tobytes()).decode("ascii")
    return document


def in_short(specification: Specification) -> dict[str, Any]:
    """As `to_dict`, but of poses only their number, as `pose_count`: what lists and views of jobs show."""
    document, poses = _without_poses(specification)
    return document if poses is None else {**document, _POSE_COUNT: len(poses)}


def from_dict(document: Mapping[str, Any]) -> Specification:
    """Inverse of `to_dict`, poses also as lists; what is left out keeps its default.

    Raises InvalidArgument, whose field is a path, also for an unknown kind.
    """
    values = dict(document)
    if isinstance(values.get(_POSES), str):
        values[_POSES] = _unpacked(values[_POSES])
    return contract.from_dict(Specification, values)


def value_in(document: Mapping[str, Any], role: str) -> str | None:
    """The dataset or scene that a job's JSON names in a role: needs_dataset, needs_scene or makes_scene."""
    field = getattr(Specification.member(document["kind"]), role)
    return None if field is None else document.get(field)


def carried_name(document: Mapping[str, Any]) -> str | None:
    """What the file that a job's JSON tells of is called where it is kept for the job."""
    field = Specification.member(document["kind"]).carries
    file = None if field is None else document.get(field)
    return None if file is None else f"{field}.{file['format']}"


def check_carried(*, document: dict[str, Any]) -> None:
    """The work of a helper process: raises what the file that comes with a job is refused for."""
    specification = from_dict(document)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, str(carried_name(document)))
        path.write_bytes(specification.carried_content())
        specification.check_carried(path)


def has_checkpoints(document: Mapping[str, Any]) -> bool:
    """Whether a job's JSON asks for work that, interrupted, goes on from where it was."""
    return Specification.member(document["kind"]).has_checkpoints or is_in_shards(document)


def is_in_shards(document: Mapping[str, Any]) -> bool:
    """Whether a job's JSON asks for a batch, whose shards many workers make."""
    return Specification.member(document["kind"]).is_in_shards(document)


def _without_poses(specification: Specification) -> tuple[dict[str, Any], FloatArray | None]:
    names = [
        item.name for item, _ in contract.annotated_fields(type(specification)) if item.name not in ("kind", _POSES)
    ]
    values = {name: contract.to_dict(getattr(specification, name), with_none=False) for name in names}
    if (file := specification.carried) is not None:
        values[str(specification.carries)] = file.recorded()
    poses = getattr(specification, _POSES, None)
    return {"kind": specification.kind, **values}, None if poses is None else np.asarray(poses)


def _unpacked(text: str) -> FloatArray:  # [C, 4, 4] mm
    try:
        poses: FloatArray = np.frombuffer(base64.b64decode(text, validate=True), "<f8").reshape(-1, 4, 4)
    except ValueError:
        raise InvalidArgument(f"poses must be a list of 1 to {MAX_POSES} 4x4 matrices", field=_POSES) from None
    return poses
