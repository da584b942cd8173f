"""The CPU backend: the C++ kernel of docs/physics.md §5 behind the signature that backends share, differentiable."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ultragray import _cpu
from ultragray.errors import BackendUnavailable
from ultragray.geometry.probe import FloatArray, LinearProbe, Probe
from ultragray.rendering.backends.inputs import (
    THIN,
    BeamVariance,
    KernelLines,
    Kind,
    Moments,
    ScenePoses,
    as_array,
    gradient_by_poses,
    want_gradient,
)
from ultragray.rendering.limits import UNLIMITED, GivenUp, Limits
from ultragray.rendering.outputs import INTENSITY_SUM, PLANES, SUMS, WEIGHT_SUM
from ultragray.scene.gaussians import PARAMETERS, GaussianScene

INSTRUCTION_SETS: tuple[str, ...] = tuple(_cpu.instruction_sets())  # what this processor can run, best first
_Field: TypeAlias = tuple[npt.NDArray[np.float32], FloatArray, tuple[float, ...]]  # mm, the last the scene's centre


def supports(scene: GaussianScene) -> bool:
    """Whether this backend can render the scene: float32 on the CPU."""
    return scene.means.device.type == "cpu" and scene.means.dtype == torch.float32


def render_outputs(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: ScenePoses,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    outputs: Sequence[str],
    limits: Limits = UNLIMITED,
    beam: Tensor | None = None,  # [3] cm, see `beam.beam_cm`
    *,
    weighted: bool = False,  # see `registry.weighted_sums`
    instruction_set: str = "auto",
) -> dict[str, Tensor]:
    """The outputs by name, each [C, H, W] float32; differentiable once by every parameter, by poses and by the beam.

    The scene is one that it supports; limits hold for frames without gradients.
    Raises BackendUnavailable for an unknown instruction set, FrameTooCostly, GivenUp.
    """
    if instruction_set != "auto" and instruction_set not in INSTRUCTION_SETS:
        raise BackendUnavailable(
            f"instruction_set must be auto or one of {', '.join(INSTRUCTION_SETS)}, got {instruction_set!r}",
            field="instruction_set",
        )
    view = {**_view_arguments(probe, as_array(poses_cm), height, width, beam), "instruction_set": instruction_set}
    moved = scene.displacements
    varied = [*scene.splats.values(), *(one.coefficients for one in moved), *([] if beam is None else [beam])]
    if want_gradient(poses_cm) or (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in varied)):
        frames = _Render.apply(  # type: ignore[no-untyped-call]
            Kind(scene.info.intensity, weighted),
            view,
            _fields(scene),
            tuple(outputs),
            poses_cm,
            beam,
            *scene.splats.values(),
            *(one.coefficients for one in moved),
        )
        return dict(zip(outputs, frames, strict=True))
    planes = _empty_planes(view, outputs)
    _draw(scene, view, planes, limits, weighted=weighted)
    return planes


def render_grey(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    least_coverage: float,
    limits: Limits = UNLIMITED,
    beam: Tensor | None = None,  # [3] cm
    *,
    instruction_set: str = "auto",
) -> tuple[Tensor, npt.NDArray[np.float32]]:  # [C, H, W] uint8, [C]
    """B-mode as `ultragray.rendering.pixels.to_uint8` rounds it, and the share of each frame's pixels with at least so
    much coverage: in one pass, which never writes the planes. The scene is one that it supports.

    Raises FrameTooCostly, GivenUp.
    """
    view = {**_view_arguments(probe, poses_cm, height, width, beam), "instruction_set": instruction_set}
    grey = np.empty((len(poses_cm), height, width), np.uint8)  # each call of torch's would cost a frame 30 to 100 µs
    supported = np.zeros(len(poses_cm), np.int64)
    counted: dict[str, Any] = {"grey": grey, "supported": supported, "least_coverage": least_coverage}
    _draw(scene, view, {}, limits, **counted)
    return torch.from_numpy(grey), (supported / (height * width)).astype(np.float32)


def plane_sums(
    scene: GaussianScene,
    corners_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    rows: int,
    columns: int,
    spacing_cm: float,
    limits: Limits = UNLIMITED,
) -> tuple[Tensor, Tensor]:  # [C, rows, columns] both
    """Σ w and Σ I·w on planes of square pixels, over all Gaussians, as `registry.weighted_sums` has them for a probe.

    A plane's pose has its origin at the outer corner of the first pixel, x along the rows and z along the columns. The
    scene is one that it supports. Raises FrameTooCostly, GivenUp.
    """
    probe = LinearProbe(10.0 * spacing_cm * columns, 0.0, 10.0 * spacing_cm * rows)
    view = _view_arguments(probe, corners_cm, rows, columns, None) | {"start": 0.0, "instruction_set": "auto"}
    planes = _empty_planes(view, SUMS)
    _draw(scene, view, planes, limits, weighted=True, uncut=True)
    return planes[WEIGHT_SUM], planes[INTENSITY_SUM]


def _draw(
    scene: GaussianScene,
    view: dict[str, Any],
    planes: dict[str, Tensor],
    limits: Limits,
    *,
    weighted: bool = False,
    **more: Any,
) -> None:
    """Has the kernel fill planes [C, H, W], and what `more` asks for. Raises FrameTooCostly, GivenUp."""
    bounds = {"footprint_pixels": limits.footprint_pixels, "flag": limits.flag, "number": limits.number}
    arguments = {**view, **_arrays(planes), **bounds, "displacements": _fields(scene), **more}
    _within(limits, _cpu.render, _sorted(scene, weighted), **arguments)


def _fields(scene: GaussianScene) -> list[_Field]:
    """The displacements of a scene as the kernel takes them."""
    return [
        (
            one.coefficients.detach().to("cpu", torch.float32).contiguous().numpy(),
            np.ascontiguousarray(one.to_grid),
            tuple(map(float, scene.info.centre_mm)),
        )
        for one in scene.displacements
    ]


def _within(limits: Limits, kernel: Callable[..., None], scene: _cpu.PreparedScene, **arguments: Any) -> None:
    """Calls a kernel, whose errors at a limit become ours."""
    try:
        kernel(scene, **arguments)
    except _cpu.GivenUp:
        raise GivenUp from None
    except _cpu.TooCostly as error:
        raise limits.too_costly(*error.args) from None


def footprint_pixels(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    limits: Limits = UNLIMITED,
    beam: Tensor | None = None,  # [3] cm
    *,
    instruction_set: str = "auto",
) -> list[int]:  # [C]
    """The cost of each pose (`ultragray.rendering.limits`), without drawing it. Raises GivenUp."""
    view = _view_arguments(probe, poses_cm, height, width, beam)
    pixels = np.empty(len(poses_cm), np.int64)
    _within(
        limits,
        _cpu.footprints,
        _sorted(scene),
        **view,
        instruction_set=instruction_set,
        pixels=pixels,
        flag=limits.flag,
        number=limits.number,
        displacements=_fields(scene),
    )
    return pixels.tolist()


def drawing_work(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: FloatArray,  # [C, 4, 4] about the scene's centre
    height: int,
    width: int,
    *,
    instruction_set: str = "auto",
) -> dict[str, npt.NDArray[np.int64]]:
    """What drawing takes, each [C, S] for the strips of 64 scan lines that a frame is drawn in.

    `slices`, `groups` (vectors of scan lines across a slice), `rows` of all groups, and `lanes` of all rows: those
    whose scan line its slice touches.
    """
    view = _view_arguments(probe, poses_cm, height, width, None)
    work = np.array(_cpu.drawing_work(_sorted(scene), **view, instruction_set=instruction_set), np.int64)
    return dict(
        zip(("slices", "groups", "rows", "lanes"), work.reshape(len(poses_cm), -1, 4).transpose(2, 0, 1), strict=True)
    )


def _sorted(scene: GaussianScene, weighted: bool = False) -> _cpu.PreparedScene:
    kind = Kind(scene.info.intensity, weighted)
    return scene.prepared(kind.place("cpu"), lambda: _prepare(scene.splats, kind))


def _view_arguments(probe: Probe, poses_cm: FloatArray, height: int, width: int, beam: Tensor | None) -> dict[str, Any]:
    return {
        **_image_arguments(probe, height, width),
        "beam": THIN if beam is None else BeamVariance.of(beam, probe, height),
        "poses": np.ascontiguousarray(KernelLines.of(probe).view_axes(poses_cm)),
        "threads": torch.get_num_threads(),
    }


@lru_cache(maxsize=64)  # each frame asks for those of its probe
def _image_arguments(probe: Probe, height: int, width: int) -> dict[str, Any]:
    lines = KernelLines.of(probe)
    return {
        **{name: getattr(lines, name) for name in ("fanned", "wrap", "start", "span")},
        "near_cm": probe.near_mm / 10.0,
        "far_cm": probe.far_mm / 10.0,
        "cull_far_cm": probe.cull_far_mm(height) / 10.0,
        "height": height,
        "width": width,
    }


def _empty_planes(view: dict[str, Any], names: Sequence[str]) -> dict[str, Tensor]:  # [C, H, W] each
    shape = (len(view["poses"]), view["height"], view["width"])
    return {name: torch.empty(shape, dtype=torch.float32, device="cpu") for name in names}


def _arrays(planes: dict[str, Tensor]) -> dict[str, Any]:
    return {name: planes[name].numpy() if name in planes else None for name in (*PLANES, *SUMS)}


class _Render(torch.autograd.Function):
    """The kernel's backward pass (docs/physics.md §4) as torch sees it."""

    @staticmethod
    def forward(
        ctx: Any,
        kind: Kind,
        view: dict[str, Any],
        fields: list[_Field],
        names: tuple[str, ...],
        poses: ScenePoses,
        beam: Tensor | None,
        *varied: Tensor,  # raw parameters, and the coefficients of each displacement
    ) -> tuple[Tensor, ...]:
        planes = _empty_planes(view, names)
        splats, coefficients = varied[: len(PARAMETERS)], varied[len(PARAMETERS) :]
        scene = _prepare(dict(zip(PARAMETERS, splats, strict=True)), kind, as_given=True)
        ctx.recording = _cpu.Recording(scene, **view, **_arrays(planes), displacements=fields)
        ctx.fields = coefficients if any(ctx.needs_input_grad[6 + len(PARAMETERS) :]) else ()
        ctx.names, ctx.poses = names, poses
        ctx.shapes = [tensor.shape for tensor in splats]
        ctx.beam = beam.detach() if beam is not None and beam.requires_grad else None
        ctx.set_materialize_grads(False)
        return tuple(planes.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        wanted = {
            name: gradient.contiguous()
            for name, gradient in zip(ctx.names, gradients, strict=True)
            if gradient is not None
        }
        means, scales, quats, transmittances, sh0, shn = (
            torch.empty(shape, dtype=torch.float32, device="cpu") for shape in ctx.shapes
        )
        views = torch.empty((len(ctx.poses), 2, 3), dtype=torch.float64) if ctx.needs_input_grad[4] else None
        fields = [torch.zeros(one.shape, dtype=torch.float32) for one in ctx.fields]
        moments = np.empty(3)
        ctx.recording.differentiate(
            threads=torch.get_num_threads(),
            **_arrays(wanted),
            means=means.numpy(),
            scales=scales.numpy(),
            quats=quats.numpy(),
            transmittances=transmittances.numpy(),
            sh0=sh0.view(-1).numpy(),
            shn=shn.squeeze(-1).numpy(),
            views=None if views is None else views.numpy(),
            beam=moments,
            displacements=[one.numpy() for one in fields],
        )
        by_fields: list[Tensor | None] = [None] * (len(ctx.needs_input_grad) - 6 - len(PARAMETERS))
        by_fields[: len(fields)] = [by.to(one) for by, one in zip(fields, ctx.fields, strict=True)]
        by_poses = None if views is None else gradient_by_poses(ctx.poses.detach(), views)
        by_beam = None if ctx.beam is None else Moments(*moments.tolist()).gradient(ctx.beam)
        return (
            *(None, None, None, None, by_poses, by_beam),
            *(means, scales, quats, transmittances, sh0, shn),
            *by_fields,
        )


def _prepare(splats: Mapping[str, Tensor], kind: Kind, *, as_given: bool = False) -> _cpu.PreparedScene:
    raw = {name: tensor.detach().to("cpu", torch.float32).contiguous() for name, tensor in splats.items()}
    return _cpu.PreparedScene(
        raw["means"].numpy(),
        raw["scales"].numpy(),
        raw["quats"].numpy(),
        raw["transmittances"].numpy(),
        raw["sh0"].reshape(-1).numpy(),
        raw["shN"].squeeze(-1).numpy(),
        sh_degree=math.isqrt(raw["shN"].shape[1] + 1) - 1,
        sigmoid=kind.intensity == "sigmoid",
        weighted=kind.weighted,
        sorted=not as_given,
        threads=torch.get_num_threads(),
    )
