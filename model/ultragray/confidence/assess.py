"""The assessment of a frame: its extrapolation, and how much a real frame would look like it. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ultragray.confidence.model import ConfidenceModel
from ultragray.confidence.views import TrainingViews
from ultragray.contract import described
from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe

SUPPORT_COVERAGE = 0.3  # γ below which a pixel's error is more than twice that of the others


@dataclass(frozen=True)
class Extrapolation:
    """Of one frame. None: the scene does not know its training views, has no model, or no coverage was given."""

    distance_mm: float | None = described("Distance to the nearest training views, a mean over the image.")
    angle_deg: float | None = described("Angle to them.")
    confidence: float | None = described(
        "The MS-SSIM that a real frame at this pose is expected to have with the rendered one, 0 to 1."
    )
    supported_share: float | None = described("Share of the pixels that Gaussians support: coverage of at least 0.3.")
    contact_share: float | None = described(
        "Share of the scan lines that have contact with the skin; none where contact is assumed.", None
    )

    def figures(self) -> dict[str, float | None]:
        """FIGURES, and the share of contact where it was judged: what files hold of a frame."""
        told = {name: getattr(self, name) for name in FIGURES}
        return told if self.contact_share is None else told | {CONTACT_SHARE: self.contact_share}


CONTACT_SHARE = "contact_share"
FIGURES = tuple(figure.name for figure in fields(Extrapolation) if figure.name != CONTACT_SHARE)


def figure_arrays(extrapolations: Sequence[Extrapolation]) -> dict[str, npt.NDArray[np.float32]]:
    """Each of FIGURES, and the share of contact where it was judged, as [C]; NaN where one is not known."""
    judged = any(one.contact_share is not None for one in extrapolations)
    names = (*FIGURES, CONTACT_SHARE) if judged else FIGURES
    return {name: np.array([getattr(one, name) for one in extrapolations], dtype=np.float32) for name in names}


class Trained(Protocol):
    """A description of a scene and of its training, such as `ultragray.SceneInfo`."""

    @property
    def probe(self) -> Probe | None: ...
    @property
    def confidence(self) -> dict[str, Any]: ...
    def probe_or(self, asked: Probe | None) -> Probe: ...


class Assessor:
    """Computes the extrapolation of frames of one scene. Its distances and confidence need the pose alone."""

    def __init__(self, info: Trained, training_poses: FloatArray) -> None:  # [P, 4, 4] mm
        """Raises InvalidArgument where the scene's `confidence` is damaged or made for other training poses."""
        known = info.probe is not None and len(training_poses) > 0
        self._info = info
        self._views = TrainingViews(training_poses, info.probe_or(None)) if known else None
        self._model = read_model(info.confidence, len(training_poses)) if known else None

    def assess(
        self, poses: Any, probe: Probe | None = None, *, coverage: npt.NDArray[Any] | None = None
    ) -> list[Extrapolation]:
        """One for each pose [C, 4, 4] or [4, 4] (mm, probe→scene) of a probe (None: the scene's own).

        `coverage` [C, H, W] is the renderer's γ at these poses; a small image suffices. Raises InvalidPose, and
        InvalidProbe where no probe is known.
        """
        checked = check_poses(poses)
        shares = [] if coverage is None else supported(coverage).mean(axis=(1, 2)).tolist()
        if coverage is not None and len(shares) != len(checked):
            raise InvalidArgument(
                f"coverage must have one image for each of {len(checked)} poses, got {len(shares)}", field="coverage"
            )
        if self._views is None:
            unknown = [Extrapolation(None, None, None, None)] * len(checked)
            return unknown if coverage is None else self.with_support(unknown, shares)
        measures = self._views.measure(checked, self._info.probe_or(probe))
        confidences = [None] * len(checked) if self._model is None else self._model.predict(measures).tolist()
        away = (measures.nearest_mm.mean(axis=1).tolist(), measures.angle_deg.mean(axis=1).tolist())
        found = [Extrapolation(*values, None) for values in zip(*away, confidences, strict=True)]
        return found if coverage is None else self.with_support(found, shares)

    def with_support(self, extrapolations: Sequence[Extrapolation], shares: Sequence[float]) -> list[Extrapolation]:
        """The extrapolations of rendered frames, completed with the share of each one's pixels that has support."""
        confidences = [one.confidence for one in extrapolations]
        if self._model is not None and None not in confidences:
            confidences = self._model.limited(np.array(confidences), np.array(shares)).tolist()
        return [
            replace(one, confidence=confidence, supported_share=share)
            for one, confidence, share in zip(extrapolations, confidences, shares, strict=True)
        ]


def supported(coverage: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:  # [C, H, W] -> [C, H, W]
    """A mask of the pixels that Gaussians support: γ of at least SUPPORT_COVERAGE."""
    return np.asarray(coverage) >= SUPPORT_COVERAGE


def read_model(document: dict[str, Any], view_count: int) -> ConfidenceModel | None:
    """The model in a scene's `confidence`, None where that is empty.

    Raises InvalidArgument where it is damaged or does not have the hardness of `view_count` views.
    """
    if not document:
        return None
    model = ConfidenceModel.from_dict(document)
    if len(model.hardness) != view_count:
        raise InvalidArgument(
            f"confidence.hardness must have one number for each of {view_count} training poses, got "
            f"{len(model.hardness)}",
            field="confidence",
        )
    return model
