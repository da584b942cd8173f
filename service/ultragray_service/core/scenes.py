"""Scenes as all front doors tell them."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import described
from ultragray.geometry.probe import ElevationBeam, Probe
from ultragray.rendering.outputs import OUTPUTS
from ultragray.scene.confidence import read_model
from ultragray.scene.info import SceneHeader
from ultragray_service.access.principals import iso_time
from ultragray_service.core.scenes import CatalogEntry, finite_metrics
from ultragray_service.core.frames import OutputName
from ultragray_service.core.poses import PoseInBothForms, Position
from ultragray_service.errors import Refusal
from ultragray_service.service import Service
from ultragray_workers.jobs.owners import Kind, Ownership
from ultragray_workers.scene_names import base_name


@dataclass(frozen=True)
class SceneEntry:
    """A scene in the list. A file that cannot be read has `error`, and null for what is in the file."""

    name: str
    loaded: bool = described("By at least one render process.")
    removable: bool = described("Whether it may be deleted: scenes of the data folder may not.")
    gaussian_count: int | None = None
    image_height: int | None = None
    image_width: int | None = None
    file_bytes: int | None = None
    error: Refusal | None = None
    owner: str | None = described("Who imported or trained it; null: nobody.", None)
    private: bool = described("Whether others may not see it.", False)
    probe_kind: str | None = described("Of the probe it was trained with, such as convex; null: not known.", None)
    metrics: dict[str, float] = described("Of the training, on held-out frames.", factory=dict)
    changed_at: str | None = described("When its file was last written, ISO 8601, UTC; null: not known.", None)


@dataclass(frozen=True)
class ScenePage:
    """One page of scenes by name."""

    scenes: list[SceneEntry]
    next_page_token: str = described("Empty on the last page.")


@dataclass(frozen=True)
class Bounds:
    """A box in the scene frame, mm."""

    min_mm: Position
    max_mm: Position


@dataclass(frozen=True)
class TrainingPoses:
    """The poses that the scene has seen; frames far from them extrapolate. Where there are none, all else is null."""

    count: int
    position_min_mm: Position | None = described("Of the probe's origin.", None)
    position_max_mm: Position | None = None
    first: PoseInBothForms | None = None
    middle: PoseInBothForms | None = None
    last: PoseInBothForms | None = None

    @classmethod
    def of(cls, header: SceneHeader) -> TrainingPoses:
        """The training poses of a scene, in short."""
        poses = header.training_poses
        if not len(poses):
            return cls(count=0)
        positions = poses[:, :3, 3]
        return cls(
            count=len(poses),
            position_min_mm=Position.of(positions.min(axis=0)),
            position_max_mm=Position.of(positions.max(axis=0)),
            first=PoseInBothForms.of(poses[0]),
            middle=PoseInBothForms.of(poses[len(poses) // 2]),
            last=PoseInBothForms.of(poses[-1]),
        )


@dataclass(frozen=True)
class ConfidenceFit:
    """How well a scene knows the confidence of its frames."""

    error: float = described("Mean absolute error of the confidence on the views it was fitted on.")
    fitted_on: int = described("How many those are.")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """All that a scene says about itself; null where it is unknown."""

    name: str
    loaded: bool = described("By at least one render process.")
    loaded_processes: int = described("How many render processes hold it.")
    file_bytes: int
    gaussian_count: int
    sh_degree: int
    intensity: str
    centre_mm: Position
    bounds: Bounds = described("Of the Gaussians' means.")
    probe: Probe | None = described("The one it was trained with.")
    image_height: int | None
    image_width: int | None
    training_poses: TrainingPoses
    metrics: dict[str, float]
    dataset_name: str | None
    dataset_sha256: str | None
    outputs: list[OutputName] = described("What can be rendered of it.")
    label_names: dict[int, str] = described("What the values of the output labels mean; empty: it has none.")
    beam: ElevationBeam | None = described("Of the frames it was trained on; null: they are taken for planes.")
    confidence: ConfidenceFit | None = described("null: the scene cannot tell the confidence of its frames.")
    owner: str | None = described("Who imported or trained it; null: nobody.")
    private: bool = described("Whether others may not see it.")

    @property
    def bounds_min_mm(self) -> Position:
        return self.bounds.min_mm

    @property
    def bounds_max_mm(self) -> Position:
        return self.bounds.max_mm

    @classmethod
    def of(cls, name: str, header: SceneHeader, loaded_processes: int, ownership: Ownership) -> Scene:
        """The scene of a header, which so many render processes hold."""
        info, model = header.info, read_model(header.info.confidence, len(header.training_poses))
        return cls(
            name=name,
            loaded=loaded_processes > 0,
            loaded_processes=loaded_processes,
            file_bytes=header.file_bytes,
            gaussian_count=info.gaussian_count,
            sh_degree=info.sh_degree,
            intensity=info.intensity,
            centre_mm=Position.of(info.centre_mm),
            bounds=Bounds(Position.of(info.bounds_min_mm), Position.of(info.bounds_max_mm)),
            probe=info.probe,
            image_height=info.image_height,
            image_width=info.image_width,
            training_poses=TrainingPoses.of(header),
            metrics=finite_metrics(header),
            dataset_name=None if info.dataset_name is None else str(info.dataset_name),
            dataset_sha256=None if info.dataset_sha256 is None else str(info.dataset_sha256),
            outputs=[name for name, output in OUTPUTS.items() if output.lacks(info) is None],
            label_names=info.label_names,
            beam=info.beam,
            confidence=None if model is None else ConfidenceFit(model.error, model.fitted_on),
            owner=ownership.owner,
            private=ownership.private,
        )


@dataclass(frozen=True)
class SceneLoaded:
    """A scene after it was loaded or unloaded."""

    scene: str
    loaded: bool
    loaded_processes: int = described("How many render processes hold it.")

    @classmethod
    def of(cls, scene: str, loaded_processes: int) -> SceneLoaded:
        """The scene, which so many render processes hold."""
        return cls(base_name(scene), loaded_processes > 0, loaded_processes)


async def scene(service: Service, name: str) -> Scene:
    """Raises SceneNotFound, SceneFileInvalid."""
    header, name = await service.catalog.header(name), base_name(name)
    loaded_processes = service.pool.loaded().get(name, 0)
    return Scene.of(name, header, loaded_processes, service.owners.known(Kind.SCENE, name))


async def scene_page(service: Service, page_size: int, page_token: str) -> ScenePage:
    """One page of scenes by name. Raises InvalidArgument."""
    entries, next_page_token = await service.catalog.page(page_size, page_token)
    loaded, removable = service.pool.loaded(), await service.imports.removable()
    told = [
        _entry(one, one.name in loaded, one.name in removable, service.owners.known(Kind.SCENE, one.name))
        for one in entries
    ]
    return ScenePage(told, next_page_token)


def _entry(entry: CatalogEntry, loaded: bool, removable: bool, ownership: Ownership) -> SceneEntry:
    owner, private = ownership.owner, ownership.private
    if entry.error is not None:
        refusal = Refusal.of(entry.error)
        return SceneEntry(entry.name, loaded, removable, error=refusal, owner=owner, private=private)
    assert entry.header is not None
    info = entry.header.info
    return SceneEntry(
        entry.name,
        loaded,
        removable,
        info.gaussian_count,
        info.image_height,
        info.image_width,
        entry.header.file_bytes,
        owner=owner,
        private=private,
        probe_kind=None if info.probe is None else info.probe.kind,
        metrics=finite_metrics(entry.header),
        changed_at=None if entry.changed_at_s is None else iso_time(entry.changed_at_s),
    )
