"""Poses in, frames out: `render` draws the outputs of a scene by the backend that fits, `show` turns them into what a
display shows, and `render_shown` does both as the settings of a request want it.

From scene and settings to pixels: contact (`touch_of`, `press`) → `derived.Drawing` (the backend's
planes; air, tools and ghosts put into them) → outputs (`ultragray.rendering.outputs`) → `show`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from ultragray.errors import InvalidArgument
from ultragray.geometry.image_size import check_image_size
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import ElevationBeam, FloatArray, Probe
from ultragray.geometry.scan_conversion import samples
from ultragray.rendering.backends import cpu
from ultragray.rendering.backends.inputs import as_array, beam_cm, scene_poses
from ultragray.rendering.backends.registry import BACKENDS, choose_backend
from ultragray.rendering.confidence import SupportWatch
from ultragray.rendering.contact import Skin, Touch
from ultragray.rendering.derived import Drawing, View, recorded_part
from ultragray.rendering.display import AS_RENDERED, FRAME_RANGE_DB, Display
from ultragray.rendering.limits import UNLIMITED, Limits
from ultragray.rendering.outputs import OUTPUTS, PLANES, check_available, check_outputs
from ultragray.rendering.overlays import ToolsInView
from ultragray.rendering.pressing import Pressing, press
from ultragray.rendering.settings import Contact, Resolved, Speckle, check_indentation, check_speckle
from ultragray.rendering.tools import ScanView, Tool
from ultragray.scene.confidence import SUPPORT_COVERAGE
from ultragray.scene.gaussians import GaussianScene

_Word = TypeVar("_Word", bound=Enum)
_CACHED_PICTURES = 8  # at 9 bytes a pixel
_LARGEST_CACHED_PICTURE = 2**20  # pixels


class Frames(Mapping[str, Tensor]):
    """Rendered frames by output, each [C, H, W]: `frames["bmode"]`, or `frames.bmode`, None where it was not asked for.

    `ultragray.rendering.outputs` says what each means. Amounts lie in [0, 1]; labels are uint8, of which
    `scene.info.label_names` tells the meaning, 0 where there is none.
    """

    def __init__(
        self, outputs: Mapping[str, Tensor], touch: Touch | None = None, pressing: Pressing | None = None
    ) -> None:
        self._outputs = dict(outputs)
        self.touch = touch  # the contact of each pose with the skin; None where it was assumed
        self.pressing = pressing  # what the face does to the tissue; None without contact pressure

    def __getitem__(self, name: str) -> Tensor:
        return self._outputs[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._outputs)

    def __len__(self) -> int:
        return len(self._outputs)

    def __getattr__(self, name: str) -> Tensor | None:
        if name not in OUTPUTS:
            raise AttributeError(f"there is no output {name!r}: outputs are {', '.join(OUTPUTS)}")
        return self._outputs.get(name)

    @property
    def contact_figures(self) -> dict[str, FloatArray]:  # [C] each
        """Those of CONTACT_FIGURES (`ultragray.scene.confidence`) that were judged."""
        shares = {} if self.touch is None else {"contact_share": self.touch.shares}
        if self.pressing is None:
            return shares
        return {**shares, "indentation_mm": self.pressing.indentation_mm, "force_n": self.pressing.force_n}

    def __repr__(self) -> str:
        count, height, width = next(iter(self._outputs.values())).shape if self._outputs else (0, 0, 0)
        return f"Frames({count:,} of {height}x{width}: {', '.join(self._outputs)})"


def render(
    scene: GaussianScene,
    probe: Probe | None,
    poses: Any,  # [C, 4, 4] or [4, 4] mm, probe→scene
    *,
    height: int,
    width: int,
    outputs: Sequence[str] = PLANES,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
    beam: ElevationBeam | Tensor | None = None,
    contact: Contact | None = None,
    indentation_mm: float | None = None,
    tools: Sequence[Tool] = (),
    ghost: float = 0.0,
    speckle: Speckle = Speckle.OFF,
) -> Frames:
    """Frames [C, height, width] of a scene seen by `probe` (None: the probe the scene was trained with) from `poses`.

    Poses are rigid probe→scene transforms in mm, in the frame of the sweep that the scene was trained from; where
    tissue followed its probe (`scene.tissue`), it does so in frames; `scene.at_rest()` takes poses in tissue at rest.
    Backends: `reference` computes in the dtype of the scene's tensors, where they are; `cpu` in float32 on as many
    threads as torch.get_num_threads(); `cuda` in float32 on the GPU that holds the scene (`scene.to("cuda")`). `auto`
    takes the fast one for where the scene is. All are differentiable with respect to the scene's tensors, and to poses
    that are a torch tensor (`cpu` and `cuda` once), labels apart; the gradients are the true ones (docs/physics.md §4).
    `beam` is how thick a slice the frames show, instead of the scene's own (None); a thickness of 0 mm is an infinitely
    thin one. A tensor [3] of its thickness, focus and depth of field in mm is differentiable too.
    `contact` makes scan lines off the skin dark (`ultragray.rendering.contact`), and under pressure displaces the
    tissue by how far the face is pressed in, or by `indentation_mm` of it (`ultragray.rendering.pressing`); the
    result's `touch` and `pressing` tell where, how far, and with which force. Gradients pass through the displaced
    tissue; by poses they are those of lines and displacement that stay where they are.
    `tools`, such as needles, are drawn into the frames (`ultragray.rendering.tools`); labels then are there for every
    scene. `ghost`, 0 to 1, is the share that a mirror image has of what is heard beyond the first strong interface
    (`ultragray.rendering.overlays`). Both are the same on every backend, have no gradient, and let that of the planes
    pass. `speckle` natural puts into B-mode, and nothing else, the speckle of scatterers that are fixed in the tissue
    (`ultragray.rendering.speckle`): the same for a pose, whatever frames are beside it; the gradient is that without.
    `limits` bound the cost of each frame and can end the rendering (`ultragray.rendering.limits`), but for frames
    with gradients: FrameTooCostly, GivenUp.
    Raises InvalidPose, InvalidProbe, InvalidImageSize, UnknownOutput (also for labels of a scene that carries none),
    BackendUnavailable, MemoryExceeded where the GPU's memory does not suffice, and InvalidArgument for a contact that
    is none, where contact is asked for and the scene knows no skin, for an indentation without pressure, and for
    speckle of a scene that does not know its own.
    """
    chosen = check_outputs(outputs)
    check_available(chosen, scene.info, with_tools=bool(tools))
    check_image_size(height, width)
    view = (
        scene.info.probe_or(probe),
        scene_poses(scene, poses),
        int(height),
        int(width),
    )
    contact = None if contact is None else _one_of(Contact, contact, "contact", ", or None")
    check_indentation(indentation_mm, contact)
    touch = touch_of(scene, view[0], poses, view[3]) if contact is not None else None
    pressing = None
    if touch is not None and contact is Contact.PRESSURE:
        pressing = press(scene, view[0], check_poses(poses), touch, indentation_mm, tools)
        if pressing.displacement is not None:
            scene = scene.under(*scene.displacements, pressing.displacement)
    chosen_backend = choose_backend(backend, scene)
    draw = BACKENDS[chosen_backend].draw
    scene.check_displacements(len(view[1]))
    speckle = _one_of(Speckle, speckle, "speckle")
    check_speckle(speckle, scene.info)
    speckle_by = chosen_backend if speckle is Speckle.NATURAL else None
    scene_beam = beam_cm(scene.info.beam if beam is None else beam, view[0])
    sight = _tools_in_view(tools, view, poses, scene_beam)
    touching = None if touch is None else touch.lines
    drawing = Drawing(draw, scene, view, limits, scene_beam, touching, sight, ghost, speckle_by)
    drawing.draw(list(dict.fromkeys(plane for name in chosen for plane in OUTPUTS[name].planes)))
    return Frames({name: OUTPUTS[name].derive(drawing) for name in chosen}, touch, pressing)


class GreyFrames(NamedTuple):
    """B-mode in 8 bits, as `ultragray.rendering.pixels.to_uint8` rounds it."""

    bmode: Tensor  # [C, H, W] uint8
    supported: npt.NDArray[np.float32]  # [C]: the share of each frame's pixels with SUPPORT_COVERAGE


def render_grey(
    scene: GaussianScene,
    probe: Probe | None,
    poses: Any,  # [C, 4, 4] or [4, 4] mm, probe→scene
    *,
    height: int,
    width: int,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
    beam: ElevationBeam | None = None,
    touch: Touch | None = None,
) -> GreyFrames | None:
    """B-mode as `render` has it, in one pass that writes no planes; None where the scene's backend has no such pass.

    Scan lines without contact in `touch` are black; None: contact is assumed. Raises what `render` raises.
    """
    draw = BACKENDS[choose_backend(backend, scene)].draw_grey
    if draw is None:
        return None
    known = scene.info.probe_or(probe)
    scene_beam = beam_cm(scene.info.beam if beam is None else beam, known)
    grey, shares = draw(scene, known, scene_poses(scene, poses), height, width, SUPPORT_COVERAGE, limits, scene_beam)
    if touch is not None:
        pixels = grey.numpy()
        np.multiply(pixels, touch.lines[:, None], out=pixels)
    return GreyFrames(grey, shares)


def _tools_in_view(tools: Sequence[Tool], view: View, poses: Any, beam: Tensor | None) -> ToolsInView | None:
    """Tools as a view sees them: rigid, where they are, whatever the probe does to the tissue."""
    if not tools:
        return None
    (probe, _, _, width), poses_mm = view, check_poses(poses)
    if beam is None:
        return ToolsInView(tools, ScanView(probe, poses_mm, width))
    sigma, focus, rayleigh = (10.0 * beam.detach()).tolist()
    return ToolsInView(tools, ScanView(probe, poses_mm, width, (sigma, focus, rayleigh)))


def _one_of(kind: type[_Word], value: Any, field: str, otherwise: str = "") -> _Word:
    try:
        return kind(value)
    except ValueError:
        words = ", ".join(one.value for one in kind)
        raise InvalidArgument(f"{field} must be one of {words}{otherwise}, got {value!r}", field=field) from None


def touch_of(scene: GaussianScene, probe: Probe, poses: Any, width: int) -> Touch:  # [C, 4, 4] or [4, 4] mm
    """The contact of a probe with the skin under the scene's training views.

    Raises InvalidPose, and InvalidArgument where the scene knows no skin.
    """
    skin = scene.prepared("skin", lambda: Skin.under(scene.training_poses, scene.info.probe))
    return Touch.of(skin, probe, poses, width)


def footprint_pixels(
    scene: GaussianScene,
    probe: Probe | None,
    poses: Any,  # [C, 4, 4] or [4, 4] mm, probe→scene
    *,
    height: int,
    width: int,
    limits: Limits = UNLIMITED,
    beam: ElevationBeam | None = None,
) -> list[int]:  # [C]
    """The cost of each frame of a scene (`ultragray.rendering.limits`), without drawing it: by the CPU, wherever the
    scene is.

    Raises InvalidPose, InvalidProbe, InvalidImageSize, and GivenUp.
    """
    check_image_size(height, width)
    view = scene.info.probe_or(probe), as_array(scene_poses(scene, poses)), int(height), int(width)
    return cpu.footprint_pixels(scene, *view, limits, beam_cm(beam or scene.info.beam, view[0]))


def render_shown(
    scene: GaussianScene,
    settings: Resolved,
    poses: FloatArray,  # [C, 4, 4] mm
    *,
    outputs: Sequence[str] | None = None,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
    support: SupportWatch | None = None,
    in_bytes: bool = False,
) -> dict[str, Tensor]:  # [C, H', W'] by output
    """Frames as settings have them shown: the one way from the settings of a request to pixels, of pool and files.

    `outputs`: instead of those of the settings. With `support` it sees the coverage of each frame, and pixels are black
    where it masks them. `in_bytes`: B-mode alone may come rounded to uint8. Raises what `render` raises.
    """
    names = settings.outputs if outputs is None else tuple(outputs)
    if settings.breathing is not None:
        raise InvalidArgument("breathing is by the clock of a service: frames of files want a phase", field="breathing")
    scene = scene.at_phase(settings.phase) if settings.phase else scene
    is_recorded = not scene.info.made_labels
    is_plain = is_recorded and _is_plain(settings) and not (support is not None and support.masks)
    if in_bytes and names == ("bmode",) and is_plain:
        grey = render_grey(
            scene,
            settings.probe,
            poses,
            height=settings.height,
            width=settings.width,
            backend=backend,
            limits=limits,
            beam=settings.beam,
        )
        if grey is not None:
            if support is not None:
                support.note(grey.supported)
            return {"bmode": grey.bmode}
    frames = render(
        scene,
        poses=poses,
        outputs=names if support is None else (*names, "coverage"),
        backend=backend,
        limits=limits,
        **_plane_settings(settings),
        tools=settings.tools,
        ghost=settings.ghost,
        speckle=settings.speckle,
    )
    blackened = None
    if support is not None:
        coverage = frames["coverage"] if is_recorded else recorded_coverage(scene, settings, poses, backend=backend)
        blackened = support.look(coverage, frames.contact_figures)
    rendered = {name: frames[name] for name in names}
    if settings.display == AS_RENDERED and blackened is None:
        return rendered
    if not settings.display.varies:
        return show(rendered, settings.probe, settings.display, blackened)
    pictures = []
    for place, pose in enumerate(poses):
        one = slice(place, place + 1)
        mask = None if blackened is None else blackened[one]
        frame = {name: pixels[one] for name, pixels in rendered.items()}
        pictures.append(show(frame, settings.probe, settings.display.of_frame(pose), mask))
    return {name: torch.cat([frame[name] for frame in pictures]) for name in rendered}


def recorded_coverage(
    scene: GaussianScene,
    settings: Resolved,
    poses: FloatArray,  # [C, 4, 4] mm
    *,
    backend: str = "auto",
    limits: Limits = UNLIMITED,
) -> Tensor:  # [C, H, W]
    """The coverage of frames by Gaussians that stand for what was recorded: what has been put in supports nothing."""
    recorded = recorded_part(scene)
    if recorded is None:
        return scene.means.new_zeros((len(poses), settings.height, settings.width))
    shared = _plane_settings(settings)
    return render(recorded, poses=poses, outputs=("coverage",), backend=backend, limits=limits, **shared)["coverage"]


def _plane_settings(settings: Resolved) -> dict[str, Any]:
    """What decides which tissue a frame shows, as `render` takes it."""
    return {name: getattr(settings, name) for name in ("probe", "height", "width", "beam", "contact", "indentation_mm")}


def _is_plain(settings: Resolved) -> bool:
    """Whether nothing is put into frames once they are drawn."""
    added = settings.contact is not None or settings.tools or settings.ghost or settings.speckle is not Speckle.OFF
    return settings.display == AS_RENDERED and not added


def show(
    frames: Mapping[str, Tensor], probe: Probe, display: Display, blackened: Tensor | None = None
) -> dict[str, Tensor]:
    """Each output [C, H, W] as `display` shows it, [C, H', W'] of `Display.picture`, in the type that it had.

    Pixels that are `blackened`, [C, H, W] bool, are 0 in every output but those that tell support, whatever the gain.
    """
    images = {}
    for name, pixels in frames.items():
        rows = display.rows_shown(probe, pixels.shape[1])
        images[name] = pixels[:, :rows]
        if OUTPUTS[name].is_toned and display.changes_tone:
            images[name] = _toned(images[name], display)
        if OUTPUTS[name].is_toned and display.edge:
            images[name] = _edged(images[name], display.edge)
        if blackened is not None and not OUTPUTS[name].tells_support:
            images[name] = images[name].masked_fill(blackened[:, :rows], 0)
        if display.pixel_mm is not None:
            cropped = probe.cropped(rows / pixels.shape[1])
            images[name] = _scan_converted(images[name], cropped, display.pixel_mm, nearest=OUTPUTS[name].is_numbers)
        if display.flip:
            images[name] = images[name].flip(2)
        images[name] = images[name].contiguous()
    return images


def _toned(bmode: Tensor, display: Display) -> Tensor:  # [C, H, W] -> [C, H, W]
    """Grey levels of each echo raised by its gain: 0 dB is white, `dynamic_range_db` below it black."""
    gains = torch.from_numpy(display.gains(bmode.shape[1])).to(bmode)[:, None]
    scale = FRAME_RANGE_DB / display.dynamic_range_db
    return (bmode * scale + (1.0 - scale + gains / display.dynamic_range_db)).clamp_(0.0, 1.0)


def _edged(bmode: Tensor, edge: float) -> Tensor:  # [C, H, W] -> [C, H, W]
    """Unsharp masking by the mean of 3x3 samples; at the border the outermost ones count twice."""
    blurred = avg_pool2d(pad(bmode[None], (1, 1, 1, 1), mode="replicate"), 3, stride=1)[0]
    return (bmode + edge * (bmode - blurred)).clamp_(0.0, 1.0)


def _scan_converted(frames: Tensor, probe: Probe, pixel_mm: float, *, nearest: bool) -> Tensor:  # -> [C, H', W']
    _, height, width = frames.shape
    picture = probe.picture(pixel_mm)
    is_small = picture.height * picture.width <= _LARGEST_CACHED_PICTURE
    grid, inside = (_cached_grid if is_small else _grid)(probe, height, width, pixel_mm, frames.device)
    floats = frames if frames.is_floating_point() else frames.float()
    if probe.lines.wrap:
        floats = torch.cat([floats[..., -1:], floats, floats[..., :1]], dim=-1)
    mode = "nearest" if nearest else "bilinear"
    pixels = grid_sample(floats[None], grid.to(floats), mode, padding_mode="border", align_corners=False)[0]
    pixels *= inside
    return pixels if frames.is_floating_point() else pixels.round_().to(frames.dtype)


def _grid(
    probe: Probe, height: int, width: int, pixel_mm: float, device: torch.device
) -> tuple[Tensor, Tensor]:  # [1, H', W', 2], [H', W']
    """The place of each pixel of the picture, from −1 to 1 across the frame, and whether anything is there."""
    rows, columns, inside = samples(probe, (height, width), pixel_mm)
    if probe.lines.wrap:  # the frame is then given the first column once more after the last, and the other way round
        columns, width = columns + 1.0, width + 2
    grid = np.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], axis=-1)
    return torch.from_numpy(grid.astype(np.float32))[None].to(device), torch.from_numpy(inside).to(device)


_cached_grid = lru_cache(maxsize=_CACHED_PICTURES)(_grid)
