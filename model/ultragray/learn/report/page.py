"""The page of a trained scene: one HTML file that needs nothing else.

A training job writes it. Pages that compare (the distribution ultragray-studies) add their own sections to the template
`scene.html`, and are made of the same parts.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from ultragray.installation import __version__
from ultragray.learn.evaluation.held_out import score_held_out
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation, evaluate_frames, render_sweep
from ultragray.learn.evaluation.side_by_side import DIFFERENCE_GAIN, as_picture
from ultragray.learn.report.plots import plot_frames, plot_training, svg
from ultragray.learn.report.tables import METRICS, DatasetFacts, Row, metric_rows, path_row, rank_rows, speckle_rows
from ultragray.learn.sweep import Dataset, Sweep, spread_places
from ultragray.learn.training.progress import Course
from ultragray.rendering.pixels import ByteArray, png_file, to_uint8
from ultragray.scene.gaussians import GaussianScene

MADE_OF = ("echo", "transmittance")  # what the rendering is made of
THIS_SCENE = "this scene"
PICTURE_PIXELS = 240


@dataclass(frozen=True, eq=False)
class Shown:
    """Frames [F, H, W] in [0, 1] under a title. What is no prediction has no PSNR, and no difference."""

    title: str
    frames: npt.NDArray[np.float32]
    psnr_db: Sequence[float] | None = None  # of each frame

    @classmethod
    def prediction(cls, title: str, stored: ByteArray, evaluation: Evaluation, places: Sequence[int]) -> Shown:
        """Of all frames [F, H, W] that a method expects, as a comparison keeps them, those at these places."""
        frames = (stored[list(places)] / 255.0).astype(np.float32)
        return cls(title, frames, [evaluation.frames[place].psnr_db for place in places])


@dataclass(frozen=True)
class Panel:
    """A picture, and the one of its difference, as addresses that hold the picture itself."""

    title: str
    picture: str
    difference: str | None
    note: str  # its PSNR


@dataclass(frozen=True)
class FrameOfPage:
    """A held-out frame with its panels, the truth first."""

    number: int
    kind: str  # such as "worst"; empty for frames that are evenly spread
    panels: tuple[Panel, ...]


def frames_of_page(chosen: Sweep, kinds: Sequence[str], columns: Sequence[Shown]) -> list[FrameOfPage]:
    """Each frame of the chosen ones with its kind; all of `columns` hold as many frames."""
    page_frames = []
    for row, kind in enumerate(kinds):
        truth = (chosen.images[row] / 255.0).astype(np.float32)
        panels = [Panel("truth", _address(truth, chosen), None, "")]
        for one in columns:
            frame = one.frames[row]
            difference, note = None, ""
            if one.psnr_db is not None:
                difference = _address(np.minimum(np.abs(frame - truth) * DIFFERENCE_GAIN, 1.0), chosen)
                note = f"{one.psnr_db[row]:.2f} dB"
            panels.append(Panel(one.title, _address(frame, chosen), difference, note))
        page_frames.append(FrameOfPage(int(chosen.frame_numbers[row]), kind, tuple(panels)))
    return page_frames


def telling_places(evaluation: Evaluation) -> dict[int, str]:
    """The frames where a method does worst, as usual, and best by PSNR; perhaps fewer than three."""
    order = np.argsort([-frame.psnr_db for frame in evaluation.frames], kind="stable")
    return {int(order[-1]): "worst", int(order[len(order) // 2]): "typical", int(order[0]): "best"}


def _address(frame: npt.NDArray[np.float32], sweep: Sweep) -> str:  # [H, W]
    picture = as_picture(frame, sweep, PICTURE_PIXELS)
    return "data:image/png;base64," + base64.b64encode(png_file(picture)).decode()


@dataclass(frozen=True, eq=False)
class Prediction:
    """The held-out frames [F, H, W] as something expects them at the poses given, in 256 greys, and their scores."""

    evaluation: Evaluation
    frames: ByteArray
    on_path: FrameMetrics | None = None  # the means on the path; None: not measured there, or it is as given

    @classmethod
    def of_scene(cls, scene: GaussianScene, dataset: Dataset) -> Prediction:
        frames = np.clip(render_sweep(scene, dataset.val), 0.0, 1.0)
        as_given = evaluate_frames(frames, dataset.val)
        on_path = score_held_out(scene, dataset, as_given).on_path
        return cls(as_given, to_uint8(frames), None if on_path is None else on_path.mean)


@dataclass(frozen=True, eq=False)
class ScenePage:
    """Contents of the page of a scene.

    `predictions` holds the scene first, and what it is compared with. `spread` is how many held-out frames are shown at
    most, from the first to the last; None: the worst, a typical one and the best. `course` is None for a scene that was
    read from a file.
    """

    dataset: Dataset
    scene: GaussianScene
    predictions: Mapping[str, Prediction]
    machine: str
    scene_name: str | None = None
    spread: int | None = None
    course: Course | None = None
    failures: Mapping[str, str] = field(default_factory=dict)  # why others have no prediction
    not_plotted: frozenset[str] = frozenset()  # over the frames, where their lines would hide others

    @property
    def evaluation(self) -> Evaluation:
        return next(iter(self.predictions.values())).evaluation


def render_page(page: ScenePage, template: str = "scene.html", *packages: str, **more: Any) -> str:
    """The HTML text. A template of one of these packages that extends `scene.html` is given `more`, too."""
    evaluations = {title: one.evaluation for title, one in page.predictions.items()}
    is_alone = len(evaluations) + len(page.failures) == 1
    on_path = {title: one.on_path for title, one in page.predictions.items() if one.on_path is not None}
    rows = []
    for row in metric_rows(evaluations):
        rows += [row, path_row(row.name, on_path[row.name])] if row.name in on_path else [row]
    settings = {} if page.course is None else page.scene.info.training
    values = {
        "title": page.dataset.name,
        "facts": _facts(page),
        "is_alone": is_alone,
        "has_path": bool(on_path),
        "rows": [*rows, *(Row(title, failure=why) for title, why in page.failures.items())],
        "ranks": [] if is_alone else rank_rows(evaluations),
        "speckle": speckle_rows(evaluations),
        "scales": page.evaluation.ms_ssim_scales,
        "frames_plot": plot_frames({t: one for t, one in evaluations.items() if t not in page.not_plotted}),
        "training_plot": None if page.course is None else svg(plot_training(page.course)),
        "pictures": _pictures(page),
        "configuration": {name: value for name, value in settings.items() if value is not None},
        **more,
    }
    return environment(*packages).get_template(template).render(values)


def environment(*packages: str) -> Environment:
    """The templates of these packages, and those that all pages share; with what all of them use."""
    loaders = [PackageLoader(package) for package in (*packages, __package__)]
    templates = Environment(loader=ChoiceLoader(loaders), autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    headings = [metric.heading for metric in METRICS]
    templates.globals |= {"version": __version__, "gain": DIFFERENCE_GAIN, "headings": headings}
    return templates


def _facts(page: ScenePage) -> dict[str, str]:
    scene, facts = page.scene, DatasetFacts.of(page.dataset)
    entries = {
        **({} if page.scene_name is None else {"Scene": page.scene_name}),
        "Training frames": f"{facts.train_frames}",
        "Held-out frames": f"{facts.val_frames}",
        **facts.image_words,
        "Gaussians": f"{scene.gaussian_count:,}, spherical harmonics of degree {scene.sh_degree}",
        "Intensity": scene.info.intensity,
    }
    if page.course is not None:
        entries["Training"] = (
            f"{scene.info.training['steps']:,} steps in {page.course.seconds:.0f} s, "
            f"{1000.0 * page.course.step_s:.0f} ms a step"
        )
    return {**entries, "Machine": page.machine}


def _pictures(page: ScenePage) -> list[FrameOfPage]:
    """The chosen held-out frames: the scene, what its rendering is made of, and what it is compared with."""
    kinds: Mapping[int, str] = telling_places(page.evaluation)
    if page.spread is not None:
        kinds = dict.fromkeys(spread_places(len(page.dataset.val), page.spread).tolist(), "")
    places = list(kinds)
    chosen = page.dataset.val.select(places)
    first, *others = (
        Shown.prediction(title, one.frames, one.evaluation, places) for title, one in page.predictions.items()
    )
    made_of = [Shown(output, render_sweep(page.scene, chosen, output=output)) for output in MADE_OF]
    return frames_of_page(chosen, list(kinds.values()), [first, *made_of, *others])
