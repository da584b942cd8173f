"""GaussianScene: the Gaussians of a trained scene and what they mean.

Convention. Inside a scene lengths are in cm and the origin is the scene's centre; on every public surface they are in
mm in the frame of the training sweep: p_cm = (p_mm − centre_mm) / 10.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.files import write_whole
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.scene.compressed import (
    COMPRESSED_SUFFIX,
    COMPRESSED_TENSOR,
    checked_tensor,
    pack,
    part_name,
    unpack,
)
from ultragray.scene.deformation import MAX_FIELDS, Displacement
from ultragray.scene.info import (
    BESIDE,
    LABELS_TENSOR,
    METADATA_KEY,
    REST_TENSOR,
    SceneInfo,
    check_beside,
    check_header_size,
    check_tissue,
    check_training_pose_count,
    expected_shapes,
    info_to_json,
    read_gaussians,
    read_header,
    scene_file_invalid,
    with_metadata_in_order,
    with_summary,
)
from ultragray.scene.modes import MOTION_KEY, Moving
from ultragray.scene.tissue import FollowingTissue

PARAMETERS = ("means", "scales", "quats", "transmittances", "sh0", "shN")
LARGEST = {"means": 1e6, "scales": 20.0} | dict.fromkeys(("quats", "transmittances", "sh0", "shN"), 1e6)
LEAST_NORM = 1e-6  # of a quaternion: squares of smaller ones vanish in float32

Prepared = TypeVar("Prepared")


class _Kept(NamedTuple):
    """A preparation of a scene and its sources: holding the tensors keeps their identity from being reused."""

    tensors: tuple[Tensor, ...]
    versions: tuple[int, ...]
    intensity: str
    value: Any

    def is_of(self, tensors: tuple[Tensor, ...], intensity: str) -> bool:
        """Whether it was made of these, as they are now."""
        if len(self.tensors) != len(tensors) or self.intensity != intensity:
            return False
        for kept, version, tensor in zip(self.tensors, self.versions, tensors, strict=True):
            if kept is not tensor or tensor._version != version:
                return False
        return True


@dataclass(eq=False)
class GaussianScene:
    """Raw parameters (docs/physics.md §2), as a released checkpoint's `splats` holds them, and the scene's description.

    The parameters share one floating dtype and one device. Where the Gaussians carry labels, `info.label_names` says
    what they mean; 0 is no label. `GaussianScene.from_splats` checks them; use that.
    """

    means: Tensor  # [N, 3] cm
    scales: Tensor  # [N, 3] log cm
    quats: Tensor  # [N, 4] wxyz, any norm but 0
    transmittances: Tensor  # [N] logit
    sh0: Tensor  # [N, 1, 1]
    shN: Tensor  # [N, K-1, 1]  # noqa: N815 (the released name)
    info: SceneInfo = field(default_factory=SceneInfo)
    training_poses: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))  # [P, 4, 4] mm
    labels: Tensor | None = None  # [N] uint8
    pose_corrections: FloatArray | None = None  # [P, 4, 4] mm: training poses = corrections · poses of the tracker
    rest_poses: FloatArray | None = None  # [P, 4, 4] mm: where the tissue at rest looks as training frames do
    moving: Moving | None = None  # how its tissue moves; its motion is info.motion
    displacements: tuple[Displacement, ...] = ()  # of its tissue, see `under`; no part of the file
    _prepared: dict[str, _Kept] = field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        name = "" if self.info.dataset_name is None else f"{self.info.dataset_name!r}, "
        return f"GaussianScene({name}{len(self.means):,} Gaussians, {self.info.probe or 'no probe'})"

    def __getstate__(self) -> dict[str, Any]:
        """For copies and other processes, which prepare themselves anew."""
        return {**vars(self), "_prepared": {}}

    @classmethod
    def from_splats(
        cls,
        splats: Mapping[str, Tensor],
        *,
        info: SceneInfo | None = None,
        training_poses: Any = None,  # [P, 4, 4] mm
        labels: Tensor | None = None,  # [N] uint8
        pose_corrections: Any = None,  # [P, 4, 4] mm
        rest_poses: Any = None,  # [P, 4, 4] mm
        moving: Moving | None = None,
    ) -> GaussianScene:
        """A scene of raw released parameters, lengths in cm; the graph of the tensors is kept.

        Labels that `info.label_names` does not name are called after their number.
        Raises InvalidArgument, naming the tensor, for a missing key, a wrong shape, mixed dtypes or devices, no
        Gaussian at all, and values that no scene has: not finite, beyond LARGEST, quaternions of no length.
        """
        missing = [name for name in PARAMETERS if name not in splats and name != "shN"]
        if missing:
            raise InvalidArgument(
                f"splats must hold {', '.join(PARAMETERS)}; missing {', '.join(missing)}", field="splats"
            )
        tensors: dict[str, Any] = {name: splats[name] for name in PARAMETERS if name in splats}
        for name, tensor in tensors.items():
            if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
                raise InvalidArgument(
                    f"splats[{name!r}] must be a floating tensor, got {type(tensor).__name__}", field=name
                )
        means = tensors["means"]
        count = means.shape[0] if means.ndim else 0
        if "shN" not in tensors:
            tensors["shN"] = means.new_zeros((count, 0, 1))
        shn = tensors["shN"]
        degree = {0: 0, 3: 1, 8: 2, 15: 3}.get(shn.shape[1] if shn.ndim == 3 else -1)
        if degree is None:
            raise InvalidArgument(
                f"splats['shN'] must be [N, K-1, 1] with K-1 in 0, 3, 8, 15, got {list(shn.shape)}",
                field="shN",
            )
        for name, shape in expected_shapes(count, degree).items():
            tensor = tensors[name]
            if tuple(tensor.shape) != shape:
                raise InvalidArgument(
                    f"splats[{name!r}] must have shape {list(shape)}, got {list(tensor.shape)}", field=name
                )
            if tensor.dtype != means.dtype or tensor.device != means.device:
                raise InvalidArgument(
                    f"splats[{name!r}] must be {means.dtype} on {means.device} like means, got {tensor.dtype} on "
                    f"{tensor.device}",
                    field=name,
                )
            _check_values(name, tensor.detach())
        if count == 0:
            raise InvalidArgument("splats must hold at least one Gaussian", field="splats")
        poses = np.zeros((0, 4, 4)) if training_poses is None else check_poses(training_poses, field="training_poses")
        check_training_pose_count(len(poses))
        described = replace(info or SceneInfo(), motion=None if moving is None else moving.motion)
        summary = with_summary(described, means.detach().cpu().double().numpy(), degree)
        names = _names_of_labels(labels, means, summary.label_names)
        beside: dict[str, Any] = {
            name: None if motions is None else check_beside(name, motions, len(poses))
            for name, motions in zip(BESIDE, (pose_corrections, rest_poses), strict=True)
        }
        check_tissue(summary, beside[REST_TENSOR])
        return cls(
            **tensors,
            info=replace(summary, label_names=names),
            training_poses=poses,
            labels=labels,
            **beside,
            moving=moving,
        )

    @property
    def gaussian_count(self) -> int:
        return self.info.gaussian_count

    @property
    def sh_degree(self) -> int:
        return self.info.sh_degree

    @property
    def splats(self) -> dict[str, Tensor]:
        """The six raw parameter tensors by their released names."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def to(self, target: torch.dtype | torch.device | str) -> GaussianScene:
        """The same scene with its tensors in another dtype or on another device."""
        moved: dict[str, Any] = {name: tensor.to(target) for name, tensor in self.splats.items()}
        labels = None if self.labels is None else self.labels.to(moved["means"].device)
        return replace(self, **moved, labels=labels)

    def prepared(self, name: str, make: Callable[[], Prepared]) -> Prepared:
        """A backend's preparation of the scene, kept by name until one of the tensors, or the activation, changes.

        A change that torch does not count (through `.data`) is not noticed.
        """
        tensors = (*self.splats.values(), *(() if self.labels is None else (self.labels,)))
        kept = self._prepared.get(name)
        if kept is None or not kept.is_of(tensors, self.info.intensity):
            if any(tensor.is_inference() for tensor in tensors):  # their changes are not counted
                return make()
            versions = tuple(tensor._version for tensor in tensors)
            kept = _Kept(tensors, versions, self.info.intensity, make())
            self._prepared[name] = kept  # one assignment: threads may render the scene at the same time
        preparation: Prepared = kept.value
        return preparation

    @property
    def tissue(self) -> FollowingTissue | None:
        """The way from poses as tracked to the tissue at rest; None where they are the same."""
        rest, shares = self.rest_poses, self.info.tissue_shares
        if rest is None or shares is None:
            return None
        return self.prepared(
            "tissue",
            lambda: FollowingTissue(self.training_poses, rest, self.pose_corrections, shares, self.info.probe_or(None)),
        )

    def poses_at_rest(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """Poses as tracked, in the tissue at rest."""
        return poses if self.tissue is None else self.tissue.at_rest(poses)

    def poses_as_tracked(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] mm
        """Poses in the tissue at rest, as tracked."""
        return poses if self.tissue is None else self.tissue.tracked(poses)

    def at_rest(self) -> GaussianScene:
        """The same for poses in the tissue at rest, its training poses among them; itself where tissue is rigid."""
        if (rest := self.rest_poses) is None:
            return self
        info = replace(self.info, tissue_shares=None)
        return self.prepared(
            "at rest",
            lambda: replace(self.under(), info=info, training_poses=rest, rest_poses=None, pose_corrections=None),
        ).under(*self.displacements)

    def under(self, *displacements: Displacement) -> GaussianScene:
        """The scene with its tissue displaced by these alone, one after another (`ultragray.scene.deformation`); it
        shares what was prepared of the scene at rest.

        Raises InvalidArgument for more than MAX_FIELDS.
        """
        if len(displacements) > MAX_FIELDS:
            raise InvalidArgument(
                f"tissue may be displaced by at most {MAX_FIELDS} fields, got {len(displacements)}",
                field="displacements",
            )
        moved = replace(self, displacements=displacements)
        moved._prepared = self._prepared
        return moved

    def at_phase(self, phase: Sequence[float]) -> GaussianScene:  # [M]
        """The scene with its tissue where its modes of motion have it at these numbers. Raises InvalidArgument."""
        if self.moving is None:
            raise InvalidArgument("phase needs a scene with modes of motion; this one is still", field="phase")
        motion = self.moving.motion
        numbers = np.asarray(motion.checked(phase)) - motion.rest
        if not numbers.any():
            return self.under()
        coefficients = np.einsum("m,mxyzi->xyzi", numbers, self.moving.coefficients).astype(np.float32)
        return self.under(
            Displacement.on_grid(torch.from_numpy(coefficients)[None], motion.origin_mm, motion.spacing_mm)
        )

    def check_displacements(self, pose_count: int) -> None:
        """Raises InvalidArgument where a displacement is neither for all poses of a call nor has one for each."""
        for one in self.displacements:
            if not {len(one.coefficients), len(one.to_grid)} <= {1, pose_count}:
                raise InvalidArgument(
                    f"a displacement must be one, or one for each of {pose_count} poses, got "
                    f"{len(one.coefficients)} of coefficients and {len(one.to_grid)} of places",
                    field="displacements",
                )

    def displacements_cm(self) -> tuple[Displacement, ...]:
        """Those of the tissue in the scene's own frame (cm, about its centre)."""
        return tuple(one.in_cm(self.info.centre_mm) for one in self.displacements)

    def poses_to_scene_cm(self, poses: FloatArray) -> FloatArray:  # [C, 4, 4] mm -> [C, 4, 4] cm
        """Poses in the tissue at rest (mm) as poses in the scene's own frame (cm, about its centre)."""
        inside: FloatArray = poses.copy()
        inside[:, :3, 3] = (poses[:, :3, 3] - np.asarray(self.info.centre_mm)) / 10.0
        return inside

    def to_bytes(self) -> bytes:
        """The scene file: deterministic, so that its SHA-256 names the scene.

        Raises InvalidArgument where `info` is larger than the header of a scene file may be.
        """
        tensors = {name: t.detach().to("cpu", torch.float32).contiguous() for name, t in self.splats.items()}
        if self.labels is not None:
            tensors[LABELS_TENSOR] = self.labels.cpu().contiguous()
        return self._bundle(tensors, info_to_json(self.info))

    def to_compressed_bytes(self) -> bytes:
        """The scene as a compressed file (.ugz): about a fifth of the bytes, the Gaussians in another order.

        docs/reference/scene-file.md says what frames lose. Raises as `to_bytes` does.
        """
        splats = {name: t.detach().to("cpu", torch.float32).numpy() for name, t in self.splats.items()}
        parts = pack(splats, None if self.labels is None else self.labels.cpu().numpy())
        means = unpack(parts, self.gaussian_count, self.sh_degree, self.labels is not None)["means"]
        description = info_to_json(with_summary(self.info, means.astype(np.float64), self.sh_degree))
        checked = checked_tensor(description, self.training_poses, self.pose_corrections, self.rest_poses)
        named = {COMPRESSED_TENSOR: checked, **{part_name(index): part for index, part in enumerate(parts)}}
        tensors = {name: torch.frombuffer(bytearray(one), dtype=torch.uint8) for name, one in named.items()}
        return self._bundle(tensors, description)

    def _bundle(self, gaussians: dict[str, Tensor], description: str) -> bytes:
        tensors = {**gaussians, "training_poses": torch.from_numpy(np.ascontiguousarray(self.training_poses))}
        for name in BESIDE:
            if (motions := getattr(self, name)) is not None:
                tensors[name] = torch.from_numpy(np.ascontiguousarray(motions))
        motion = {} if self.moving is None else {MOTION_KEY: self.moving.to_json()}
        data: bytes = save(tensors, metadata={METADATA_KEY: description, **motion})
        check_header_size(data)
        return with_metadata_in_order(data) if motion else data

    def save(self, path: str | Path) -> None:
        """Writes the scene file, a compressed one where the path ends in .ugz, whole or not at all.

        Raises OSError where it cannot be written.
        """
        write_whole(path, self.to_compressed_bytes() if Path(path).suffix == COMPRESSED_SUFFIX else self.to_bytes())

    @classmethod
    def load(cls, path: str | Path) -> GaussianScene:
        """Reads a scene file. Never runs code; raises SceneFileInvalid, naming the file and the reason."""
        header = read_header(path)
        try:
            tensors = {name: torch.from_numpy(values) for name, values in read_gaussians(path, header.info).items()}
            labels = tensors.pop(LABELS_TENSOR, None)
            return cls.from_splats(
                tensors,
                info=header.info,
                training_poses=header.training_poses,
                labels=labels,
                pose_corrections=header.pose_corrections,
                rest_poses=header.rest_poses,
                moving=header.moving,
            )
        except (OSError, SafetensorError, ValueError) as error:
            raise scene_file_invalid(path, error) from error


def no_smaller_than_held(splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Raw parameters in which no Gaussian is smaller than a scene can hold.

    A Gaussian that has shrunk out of sight goes on shrinking in a training: the price of its size still has a gradient,
    and steps of Adam do not get shorter with it.
    """
    return {**splats, "scales": splats["scales"].clamp(min=-LARGEST["scales"])}


def _check_values(name: str, tensor: Tensor) -> None:  # [N, ...]
    """Raises InvalidArgument, naming the first Gaussian whose values cannot be rendered, and how many there are."""
    values = tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None]
    wrong = ~(values.abs() <= LARGEST[name]).all(dim=1)  # NaN is not
    expected = f"be finite and within ±{LARGEST[name]:g}"
    if name == "quats" and not wrong.any():
        wrong, expected = values.norm(dim=1) < LEAST_NORM, "not be zero"
    if wrong.any():
        first = int(wrong.nonzero()[0])
        numbers = ", ".join(f"{value:.6g}" for value in values[first].tolist())
        raise InvalidArgument(
            f"splats[{name!r}] must {expected}, got [{numbers}] for Gaussian {first} ({int(wrong.sum())} are wrong)",
            field=name,
        )


def _names_of_labels(labels: Any, means: Tensor, known: Mapping[int, str]) -> dict[int, str]:
    """A name for each label that occurs, and those known besides. Raises InvalidArgument."""
    if labels is None:
        if known:
            raise InvalidArgument(
                f"labels must be given where info.label_names names some: {', '.join(known.values())}", field="labels"
            )
        return {}
    if not isinstance(labels, Tensor) or labels.dtype != torch.uint8 or labels.shape != means.shape[:1]:
        description = f"{labels.dtype} {list(labels.shape)}" if isinstance(labels, Tensor) else type(labels).__name__
        raise InvalidArgument(f"labels must be a uint8 tensor [{len(means)}], got {description}", field="labels")
    if labels.device != means.device:
        raise InvalidArgument(f"labels must be on {means.device} like means, got {labels.device}", field="labels")
    names = {int(label): f"label {label}" for label in torch.unique(labels).tolist() if label > 0} | dict(known)
    if not names:
        raise InvalidArgument("labels must hold one above 0, or info.label_names name one", field="labels")
    return names
