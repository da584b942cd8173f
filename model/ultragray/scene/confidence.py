"""How far a frame extrapolates from what its scene was trained on, and how much to trust it: what the pose alone tells.

In reading order: measures of poses to the training views; the model of pixels' errors and that of whole frames, fitted
by `ultragray.learn.training.confidence` and kept in the scene's file; `Assessor`, which gives each pose its
`Extrapolation`; a least confidence. What only a rendered frame tells is in `ultragray.rendering.confidence`. No torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray import _cpu
from ultragray.contract import checked_number, described, under
from ultragray.errors import InvalidArgument, LowConfidence
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe

POINTS_PER_SIDE = 6  # of the grid of image points at which distances are taken
FAR_MM = 20.0  # a frame is expected to be no worse farther away: larger distances count as this


@dataclass(frozen=True, eq=False)
class ViewMeasures:
    """Of K points of the images of C poses, row by row, and the weights of the P training views around each pose.

    distance: to the nearest training image. interpolation: a·b/(a + b) of the distances a, b to the nearest images on
    either side: half of either midway between two, all of it where there is one side only. Both count as at most
    FAR_MM; `nearest_mm` is the distance without that limit. angle: the rotation to the view of the nearest image.
    weights: of a Gaussian over the mean distances to the views, about as wide as that to the nearest, 3 mm at least.
    """

    nearest_mm: FloatArray  # [C, K]
    distance_mm: FloatArray  # [C, K]
    interpolation_mm: FloatArray  # [C, K]
    angle_deg: FloatArray  # [C, K]
    weights: FloatArray  # [C, P], each row sums to 1


class TrainingViews:
    """The images of P training poses [P, 4, 4] (mm, probe→scene) of one probe, in space. P is at least 1."""

    def __init__(self, poses: FloatArray, probe: Probe, *, instruction_set: str = "auto") -> None:
        self._count = len(poses)
        self._views = _cpu.TrainingViews(
            np.ascontiguousarray(poses),
            **probe.lines.edges._asdict(),
            near_mm=probe.near_mm,
            far_mm=probe.far_mm,
            instruction_set=instruction_set,
        )

    def __len__(self) -> int:
        return self._count

    def measure(self, poses: FloatArray, probe: Probe, points_per_side: int = POINTS_PER_SIDE) -> ViewMeasures:
        """Measures poses [C, 4, 4] (mm, exact) of a probe, which need not be the views' own.

        The nearest view of a point is that of the least distance + 0.02 mm for each degree between the frames: of two
        about as near, the less turned one.
        """
        return self._measured(poses, probe, points_per_side)[0]

    def mean_distances_mm(self, poses: FloatArray, probe: Probe) -> FloatArray:  # [C, 4, 4] mm, exact -> [C, P]
        """Root of the mean square distance of the points of each image to each view."""
        return self._measured(poses, probe, POINTS_PER_SIDE)[1]

    def interpolation_mm(self, points: FloatArray) -> FloatArray:  # [K, 3] mm -> [K]
        """As `ViewMeasures` has it, of any points of the scene's frame."""
        distances_mm = np.empty(len(points))
        self._views.interpolation_mm(np.ascontiguousarray(points, np.float32), distances_mm)
        return distances_mm

    def _measured(
        self, poses: FloatArray, probe: Probe, points_per_side: int
    ) -> tuple[ViewMeasures, FloatArray]:  # the latter [C, P] mm
        points = _image_points(probe, points_per_side)
        nearest_mm, distance_mm, interpolation_mm, angle_deg = np.empty((4, len(poses), len(points)))
        weights, around_mm = np.empty((2, len(poses), self._count))
        measures = ViewMeasures(nearest_mm, distance_mm, interpolation_mm, angle_deg, weights)
        self._views.measure(np.ascontiguousarray(poses), points, **vars(measures), around_mm=around_mm)
        return measures, around_mm


@lru_cache(maxsize=64)
def _image_points(probe: Probe, per_side: int) -> FloatArray:  # [K, 3] mm, probe frame
    origins, directions = probe.scan_lines(per_side)
    points = origins + probe.depths_mm(per_side)[:, None, None] * directions
    return np.ascontiguousarray(points.reshape(-1, 3))


# The model behind the output `uncertainty`: the variances that add up to that of a pixel's error. Needs no torch.
#
# σ² = Σ cₖ·vₖ, cₖ ≥ 0
#
# The terms vₖ are those of `ultragray.rendering.derived`. Those that grow with the distance to the training views
# are shares of V = spread + (level − B̄)²: the mean squared error of a pixel that shows B̄ where the true grey value
# may be any of those that the training images have at that depth.

VARIANCE_TERMS = (
    "floor",
    "level",
    "level²",
    "texture",
    "gap 0.3 mm",
    "gap 1 mm",
    "gap 3 mm",
    "beyond",
    "thin",
    "shadow",
)
DEPTHS = 8  # bands of depth of the training images, each with its level and spread
DIGITS = 6  # in a scene's metadata


@dataclass(frozen=True)
class DepthBands:
    """Mean and variance of the training images' grey values, in [0, 1], in bands of depth. Raises InvalidArgument."""

    level: tuple[float, ...]  # [DEPTHS]
    spread: tuple[float, ...]  # [DEPTHS]

    def __post_init__(self) -> None:
        for name in ("level", "spread"):
            object.__setattr__(self, name, _numbers(f"uncertainty.{name}", getattr(self, name), DEPTHS, low=0.0))


@dataclass(frozen=True)
class Uncertainty:
    """Fitted cₖ, and the depth bands of the training images. Raises InvalidArgument."""

    variances: tuple[float, ...]  # [TERMS]
    bands: DepthBands

    def __post_init__(self) -> None:
        variances = _numbers("uncertainty.variances", self.variances, len(VARIANCE_TERMS), low=0.0)
        object.__setattr__(self, "variances", variances)

    def to_dict(self) -> dict[str, Any]:
        numbers = {"variances": self.variances, "level": self.bands.level, "spread": self.bands.spread}
        return {name: [round(value, DIGITS) for value in values] for name, values in numbers.items()}

    @classmethod
    def from_dict(cls, document: Any) -> Uncertainty:
        """Inverse of `to_dict`, but for the digits. Raises InvalidArgument for keys or values that cannot be."""
        _check_keys("uncertainty", document, {"variances", "level", "spread"})
        return cls(document["variances"], DepthBands(document["level"], document["spread"]))


def _check_keys(name: str, document: Any, keys: set[str]) -> None:
    if not isinstance(document, Mapping) or set(document) != keys:
        content = sorted(document) if isinstance(document, Mapping) else document
        raise InvalidArgument(f"{name} must be an object with the keys {sorted(keys)}, got {content!r}", field=name)


def _numbers(name: str, values: Any, count: int | None = None, low: float = -math.inf) -> tuple[float, ...]:
    """Finite numbers, as many as `count` (None: any number of them), at least `low`."""
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise InvalidArgument(f"{name} must be numbers, got {values!r}", field=name) from None
    if not all(map(math.isfinite, numbers)):
        raise InvalidArgument(f"{name} must be finite, got {values!r}", field=name)
    if count not in (None, len(numbers)) or min(numbers, default=low) < low:
        raise InvalidArgument(f"{name} must be {count} numbers, at least {low:g}, got {values!r}", field=name)
    return numbers


# The model behind the figure `confidence`: logistic curves over how points of a frame lie to the training views.
#
# c = b + (1 − b)·mean over points of σ(w₀ − w₁·log(1 + i/0.3 mm) − w₂·d/5 mm − w₃·φ/10° − w₄·h)
#
# d, i and φ are the distance, the interpolation distance and the angle of `ViewMeasures`; h is how hard the place is:
# the `hardness` of the training views around the pose, by their weights. b is what a black frame reaches. w₁ … w₄ are
# not negative, so that c never rises with d, i, φ or h. Beyond the farthest point that the weights were fitted on,
# where no frame confirms the curve, the excess of d counts twice.
#
# Where Gaussians support only the share s of a frame's pixels, c ≤ b + (1 − b)·g·s; the gain g is fitted to frames
# with little support. For a pose alone s is estimated as s₀·mean over points of exp(−d²/r²); of a rendered frame it
# is known. Needs no torch.

VERSION = 2
NEAR_MM, DISTANCE_MM, ANGLE_DEG = 0.3, 5.0, 10.0  # units of the terms
TERMS = 4  # beside the constant
HARDNESS_DIGITS = 3


@dataclass(frozen=True)
class Support:
    """The limit that the share of supported pixels sets, and what that share is expected to be at a pose.

    Raises InvalidArgument for numbers that are not finite or not positive.
    """

    gain: float  # g
    share: float  # s₀, at the views
    reach_mm: float  # r

    def __post_init__(self) -> None:
        numbers = _numbers("support", (self.gain, self.share, self.reach_mm))
        if min(numbers) <= 0.0:
            raise InvalidArgument(f"support must be positive numbers, got {list(numbers)}", field="support")


@dataclass(frozen=True)
class ConfidenceModel:
    """Fitted weights w₀ … w₄, b, and the hardness of each training view; `fitted_on` and `error` describe the fit.

    Raises InvalidArgument for numbers that are not finite or out of range.
    """

    weights: tuple[float, ...]  # w₀ … w₄
    black_ms_ssim: float  # b
    hardness: tuple[float, ...]  # [P]
    fitted_on: int  # held-out views
    error: float  # mean absolute error on those views
    support: Support | None = None  # None: it sets no limit
    fitted_to_mm: float | None = None  # the farthest point of those views; None: any
    uncertainty: Uncertainty | None = None  # of pixels; None: not known

    def __post_init__(self) -> None:
        weights = _numbers("weights", self.weights, 1 + TERMS)
        if min(weights[1:]) < 0.0:
            raise InvalidArgument(f"weights must be at least 0 from the second on, got {weights}", field="weights")
        black, error = _numbers("black_ms_ssim and error", (self.black_ms_ssim, self.error))
        if not (0.0 <= black < 1.0 and 0.0 <= error <= 1.0):
            raise InvalidArgument(
                f"black_ms_ssim and error must be in [0, 1], got {black:g} and {error:g}", field="black_ms_ssim"
            )
        with under("fitted_on"):
            checked_number(self.fitted_on, int, low=1)
        if self.fitted_to_mm is not None:
            _numbers("fitted_to_mm", [self.fitted_to_mm], 1, low=0.0)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "hardness", _numbers("hardness", self.hardness))

    def predict(self, measures: ViewMeasures) -> list[float]:  # [C]
        """The MS-SSIM expected at each pose, in [0, 1]."""
        return self._formula.predict(
            measures.distance_mm, measures.interpolation_mm, measures.angle_deg, measures.weights
        )

    def limited(self, confidence: float, supported_share: float) -> float:
        """The confidence in a frame, limited by the share of its pixels that has support."""
        return self._formula.limited(confidence, supported_share)

    @cached_property
    def _formula(self) -> _cpu.ConfidenceFormula:
        support = None if self.support is None else astuple(self.support)
        return _cpu.ConfidenceFormula(self.weights, self.black_ms_ssim, self.hardness, support, self.fitted_to_mm)

    def to_dict(self) -> dict[str, Any]:
        return {
            "version": VERSION,
            **asdict(self),
            "weights": list(self.weights),
            "hardness": [round(value, HARDNESS_DIGITS) for value in self.hardness],
            "uncertainty": None if self.uncertainty is None else self.uncertainty.to_dict(),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> ConfidenceModel:
        """Inverse of `to_dict`, but for the digits of `hardness`.

        Raises InvalidArgument for another version, a missing or a surplus key, and values that cannot be.
        """
        version = document.get("version") if isinstance(document, Mapping) else None
        if version != VERSION:
            raise InvalidArgument(
                f"confidence must be an object of version {VERSION}, got {version!r}", field="confidence"
            )
        names = {one.name for one in fields(cls)}
        _check_keys("confidence", document, {"version", *names})
        values = {name: document[name] for name in names}
        if (support := values["support"]) is not None:
            _check_keys("support", support, set(Support.__dataclass_fields__))
            values["support"] = Support(**support)
        if values["uncertainty"] is not None:
            values["uncertainty"] = Uncertainty.from_dict(values["uncertainty"])
        return cls(**values)


def terms_of(
    measures: ViewMeasures,
    hardness: FloatArray,  # [P]
    fitted_to_mm: float | None = None,
) -> FloatArray:  # [C, K, 1 + TERMS]
    """The factors of the weights at each point: 1 and the negative terms of the formula."""
    distance_mm = measures.distance_mm
    if fitted_to_mm is not None:
        distance_mm = distance_mm + np.maximum(distance_mm - fitted_to_mm, 0.0)
    terms = np.empty((*distance_mm.shape, 1 + TERMS))
    terms[..., 0] = 1.0
    terms[..., 1] = -np.log1p(measures.interpolation_mm / NEAR_MM)
    terms[..., 2] = distance_mm / -DISTANCE_MM
    terms[..., 3] = measures.angle_deg / -ANGLE_DEG
    terms[..., 4] = -(measures.weights @ hardness)[:, None]
    return terms


def predicted(weights: FloatArray, terms: FloatArray, black_ms_ssim: float) -> FloatArray:  # [C]
    """c of each pose, by the formula."""
    shares: FloatArray = logistic(terms @ weights).mean(axis=1)
    return black_ms_ssim + (1.0 - black_ms_ssim) * shares


def within(distance_mm: FloatArray, reach_mm: float) -> FloatArray:  # [C, K] -> [C]
    """The mean over the points of exp(−d²/r²)."""
    mean: FloatArray = np.exp(-np.square(distance_mm / reach_mm)).mean(axis=1)
    return mean


def logistic(values: FloatArray) -> FloatArray:
    return 1.0 / (1.0 + np.exp(np.minimum(-values, 500.0)))


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
    indentation_mm: float | None = described(
        "How far the face presses the tissue in, a mean over these lines; none without contact pressure. A frame with "
        "more than 0 shows tissue as it was not recorded.",
        None,
    )
    force_n: float | None = described("Force of the face on the tissue, along its axis; none likewise.", None)

    def figures(self) -> dict[str, float | None]:
        """FIGURES, and those of contact that were judged: what files hold of a frame."""
        return {name: getattr(self, name) for name in FIGURES + judged_figures([self])}


CONTACT_FIGURES = ("contact_share", "indentation_mm", "force_n")
FIGURES = tuple(figure.name for figure in fields(Extrapolation) if figure.name not in CONTACT_FIGURES)


def judged_figures(extrapolations: Sequence[Extrapolation]) -> tuple[str, ...]:
    """Those of CONTACT_FIGURES that any frame has."""
    return tuple(name for name in CONTACT_FIGURES if any(getattr(one, name) is not None for one in extrapolations))


def figure_arrays(extrapolations: Sequence[Extrapolation]) -> dict[str, npt.NDArray[np.float32]]:
    """Each of FIGURES, and of those of contact that were judged, as [C]; NaN where one is not known."""
    names = FIGURES + judged_figures(extrapolations)
    return {name: np.array([getattr(one, name) for one in extrapolations], dtype=np.float32) for name in names}


class Assessor:
    """Computes the extrapolation of frames of one scene. Its distances and confidence need the pose alone."""

    def __init__(self, info: Any, training_poses: FloatArray) -> None:  # SceneInfo, [P, 4, 4] mm
        """Raises InvalidArgument where the scene's `confidence` is damaged or made for other training poses."""
        known = info.probe is not None and len(training_poses) > 0
        self._info = info
        self._views = TrainingViews(training_poses, info.probe_or(None)) if known else None
        self._model = read_model(info.confidence, len(training_poses)) if known else None

    def assess(
        self,
        poses: Any,
        probe: Probe | None = None,
        *,
        coverage: npt.NDArray[Any] | None = None,
        phase: Sequence[float] = (),
    ) -> list[Extrapolation]:
        """One for each pose [C, 4, 4] or [4, 4] (mm, probe→scene) of a probe (None: the scene's own).

        `phase`: of the scene's modes of motion; confidence falls outside the range that was seen.
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
        trust = self._info.motion.trust(phase) if phase else 1.0
        confidences: Sequence[float | None] = [None] * len(checked)
        if self._model is not None:
            confidences = [trust * one for one in self._model.predict(measures)]
        away = (measures.nearest_mm.mean(axis=1).tolist(), measures.angle_deg.mean(axis=1).tolist())
        extrapolations = [Extrapolation(*values, None) for values in zip(*away, confidences, strict=True)]
        return extrapolations if coverage is None else self.with_support(extrapolations, shares)

    def with_support(self, extrapolations: Sequence[Extrapolation], shares: Sequence[float]) -> list[Extrapolation]:
        """The extrapolations of rendered frames, completed with the share of each one's pixels that has support."""
        results = []
        for one, share in zip(extrapolations, shares, strict=True):
            confidence = one.confidence
            if self._model is not None and confidence is not None:
                confidence = self._model.limited(confidence, share)
            results.append(replace(one, confidence=confidence, supported_share=share))
        return results


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


def is_confident(extrapolation: Extrapolation, min_confidence: float) -> bool:
    """Whether a frame has the least confidence; one whose confidence is not known has none."""
    return (extrapolation.confidence or 0.0) >= min_confidence


def require_confidence(
    extrapolations: Sequence[Extrapolation],
    min_confidence: float | None,
    *,
    first: int = 0,
    name_pose: Callable[[int], str] = "poses[{}]".format,
) -> None:
    """Raises LowConfidence for the first of many poses, or frames, that does not have the least confidence (None: any
    will do). That of a rendered frame is at most that of its pose.

    `first`: the number that they begin with; `name_pose`: how the caller names the pose of a number.
    """
    for number, one in enumerate(extrapolations, first):
        if min_confidence is not None and not is_confident(one, min_confidence):
            field = name_pose(number)
            detail = f"{field} has a confidence of {one.confidence or 0.0:.2f}, {min_confidence:g} is asked for"
            if one.distance_mm is not None and one.angle_deg is not None:
                away = f"{one.distance_mm:.1f} mm and {one.angle_deg:.1f} degrees away"
                detail = f"{detail}: the nearest training views are {away}"
            if one.supported_share is not None:
                detail = f"{detail}; Gaussians support {one.supported_share:.0%} of its pixels"
            raise LowConfidence(detail, field=field)
