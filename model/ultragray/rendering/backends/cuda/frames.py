"""Frames of a scene on the device: what is kept between calls, how many poses go together, and the gradient."""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ultragray.errors import MemoryExceeded, TooManyPoses
from ultragray.geometry.probe import Probe
from ultragray.rendering.backends.cuda.device import upload
from ultragray.rendering.backends.cuda.kernels.common import VIEW
from ultragray.rendering.backends.cuda.launch import (
    MAX_POSES,
    Gaussians,
    Geometry,
    Planes,
    Slices,
    bytes_per_pose,
    cut,
    differentiate,
    draw,
    empty_frames,
    launching,
    view_table,
)
from ultragray.rendering.backends.inputs import (
    Kind,
    Moments,
    ScenePoses,
    as_array,
    gradient_by_poses,
    spatial_order,
    want_gradient,
)
from ultragray.rendering.limits import Limits
from ultragray.scene.gaussians import PARAMETERS, GaussianScene

_SLICES = len(fields(Slices))
WORKSPACE_BYTES = 1 << 30  # of slices and planes; poses beyond it are rendered in a further round
GRAPHS = 4  # kept with a scene: each holds the slices and planes of a frame


def render_frames(
    scene: GaussianScene,
    probe: Probe,
    poses_cm: ScenePoses,  # [C, 4, 4]
    height: int,
    width: int,
    outputs: Sequence[str],
    limits: Limits,
    beam: Tensor | None,  # [3] cm
    weighted: bool,
) -> dict[str, Tensor]:  # [C, H, W] each
    """See `ultragray.rendering.backends.cuda.render_outputs`."""
    geometry, device = Geometry.of(probe, height, width, beam), scene.means.device
    with _on_device(device, f"{len(poses_cm)} frames of {height}x{width} pixels from {len(scene.means):,} Gaussians"):
        table = torch.from_numpy(view_table(probe, as_array(poses_cm), height, beam))
        varied = [*scene.splats.values(), *([] if beam is None else [beam])]
        by_scene = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in varied)
        if not by_scene and not want_gradient(poses_cm):
            gaussians = sorted_gaussians(scene, weighted)
            if device.type == "cuda" and len(table) == 1:
                graphs = scene.prepared(gaussians.kind.place("cuda, single frames"), lambda: _SingleFrames(gaussians))
                return graphs.render(geometry, table, tuple(outputs), limits)
            return _render(gaussians, geometry, upload(table, device), outputs, limits)
        views = upload(table, device)
        if len(views) > MAX_POSES:
            raise TooManyPoses(
                f"at most {MAX_POSES:,} poses can be differentiated together, got {len(views):,}", field="poses"
            )
        frames = _Render.apply(  # type: ignore[no-untyped-call]
            Kind(scene.info.intensity, weighted),
            geometry,
            views,
            tuple(outputs),
            poses_cm,
            beam,
            *scene.splats.values(),
        )
        return dict(zip(outputs, frames, strict=True))


@contextlib.contextmanager
def _on_device(device: torch.device, what: str) -> Iterator[None]:
    """Raises MemoryExceeded for torch's own error, and gives back what torch keeps in reserve."""
    try:
        with launching(device):
            yield
    except torch.OutOfMemoryError as error:
        torch.cuda.empty_cache()
        raise MemoryExceeded(
            f"the memory of {device} does not suffice for {what}: ask for fewer or smaller frames at once"
        ) from error


def _render(
    gaussians: Gaussians, geometry: Geometry, views: Tensor, outputs: Sequence[str], limits: Limits
) -> dict[str, Tensor]:
    """Waits for the device only where the cost of frames has a limit."""
    frames = empty_frames(outputs, len(views), geometry, views.device)
    at_once = min(MAX_POSES, max(1, WORKSPACE_BYTES // bytes_per_pose(len(gaussians.means), geometry)))
    for first in range(0, len(views), at_once):
        limits.check_flag()
        some = slice(first, first + at_once)
        slices = cut(gaussians, views[some], geometry, record=False)
        if limits.footprint_pixels is not None:
            limits.check_costs(slices.footprints.sum(dim=1).tolist(), first)
            limits.check_flag()
        those = {name: frame[some] for name, frame in frames.items()}
        draw(slices, geometry, those, keep=False, absorbs=not gaussians.kind.weighted)
    return frames


class _SingleFrames:
    """Frames of one pose at a time, as robots and pages ask for them.

    The host needs longer for a frame's launches than the device for the frame. So those of a frame that is asked for
    again, of the same probe, size and outputs, are recorded as a CUDA graph, which only the pose is copied into.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self._gaussians = gaussians
        self._graphs: OrderedDict[tuple[Any, ...], _Graph | None] = OrderedDict()  # the one used last at the end
        self._lock = threading.Lock()  # a graph's pose and frames are in one place for all who replay it

    def render(
        self, geometry: Geometry, table: Tensor, outputs: tuple[str, ...], limits: Limits
    ) -> dict[str, Tensor]:  # [1, H, W] each
        """Frames of the view that `table` [1, VIEW] holds, on the current stream."""
        device = self._gaussians.means.device
        key = geometry, outputs, torch.cuda.current_stream(device).cuda_stream
        with self._lock:
            is_new = key not in self._graphs
            graph = None if is_new else self._graphs[key] or _Graph(self._gaussians, geometry, outputs)
            self._graphs[key] = graph
            self._graphs.move_to_end(key)
            if len(self._graphs) > GRAPHS:
                self._graphs.popitem(last=False)
            if graph is not None:
                limits.check_flag()
                frames, footprints = graph.replay(table)
        if graph is None:
            return _render(self._gaussians, geometry, upload(table, device), outputs, limits)
        if limits.footprint_pixels is not None:
            limits.check_costs([int(footprints)])
        return frames


class _Graph:
    """The launches of one frame, recorded."""

    def __init__(self, gaussians: Gaussians, geometry: Geometry, outputs: Sequence[str]) -> None:
        device = gaussians.means.device
        self._views = torch.zeros((1, VIEW.value), dtype=torch.float64, device=device)
        self._graph = torch.cuda.CUDAGraph()
        stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]  # the default one cannot be recorded
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(stream):
            self._graph.capture_begin(capture_error_mode="thread_local")
            try:
                slices = cut(gaussians, self._views, geometry, record=False)
                self._frames = empty_frames(outputs, 1, geometry, device)
                draw(slices, geometry, self._frames, keep=False, absorbs=not gaussians.kind.weighted)
                self._footprints = slices.footprints.sum()
            finally:
                self._graph.capture_end()
        torch.cuda.current_stream(device).wait_stream(stream)

    def replay(self, table: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """The frames of a view, and the sum of their footprint pixels, in tensors of their own."""
        self._views.copy_(table.pin_memory(), non_blocking=True)
        self._graph.replay()
        return {name: frame.clone() for name, frame in self._frames.items()}, self._footprints.clone()


class _Render(torch.autograd.Function):
    """The kernels' backward pass (docs/physics.md §4) as torch sees it."""

    @staticmethod
    def forward(
        ctx: Any,
        kind: Kind,
        geometry: Geometry,
        views: Tensor,
        names: tuple[str, ...],
        poses: ScenePoses,
        beam: Tensor | None,
        *splats: Tensor,
    ) -> tuple[Tensor, ...]:
        gaussians = Gaussians.of(dict(zip(PARAMETERS, splats, strict=True)), kind)
        slices = cut(gaussians, views, geometry, record=True)
        frames = empty_frames(names, len(views), geometry, views.device)
        planes = draw(slices, geometry, frames, keep=True, absorbs=not kind.weighted)
        # Saved by torch: a parameter that changes before the backward pass is noticed, and all is freed after it.
        ctx.save_for_backward(*splats, views, *vars(slices).values(), *vars(planes).values())
        ctx.kind, ctx.geometry, ctx.names, ctx.poses = kind, geometry, names, poses
        ctx.beam = beam.detach() if beam is not None and beam.requires_grad else None
        ctx.set_materialize_grads(False)
        return tuple(frames.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        by_output = {
            name: gradient.contiguous()
            for name, gradient in zip(ctx.names, gradients, strict=True)
            if gradient is not None
        }
        saved = list(ctx.saved_tensors)
        splats, (views, *rest) = saved[: len(PARAMETERS)], saved[len(PARAMETERS) :]
        slices, planes = Slices(*rest[:_SLICES]), Planes(*rest[_SLICES:])
        with _on_device(views.device, f"the gradient of {len(views)} frames"):
            gaussians = Gaussians.of(dict(zip(PARAMETERS, splats, strict=True)), ctx.kind)
            by_views = _room_for_views(slices) if ctx.needs_input_grad[4] else None
            by_parameter, moments = differentiate(gaussians, views, ctx.geometry, slices, planes, by_output, by_views)
            by_beam = None if ctx.beam is None else Moments(*moments.tolist()).gradient(ctx.beam)
        by_poses = None
        if by_views is not None:
            by_poses = gradient_by_poses(ctx.poses.detach(), by_views.sum(dim=1).cpu())
        return (None, None, None, None, by_poses, by_beam, *by_parameter.values())


def _room_for_views(slices: Slices) -> Tensor:  # [C, B, 2, 3]
    return slices.slices.new_zeros((*slices.counts.shape, 2, 3), dtype=torch.float64)


def sorted_gaussians(scene: GaussianScene, weighted: bool = False) -> Gaussians:
    """The scene's Gaussians along a space-filling curve, kept with the scene until one of its tensors changes."""
    kind = Kind(scene.info.intensity, weighted)

    def sort() -> Gaussians:
        order = spatial_order(scene.means)
        return Gaussians.of({name: t.detach()[order] for name, t in scene.splats.items()}, kind)

    return scene.prepared(kind.place("cuda"), sort)
