"""`ultragray report`: a scene, the baselines and the ablations on one page."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.learn.training.config import PRESET_MEANINGS, TrainingConfig
from ultragray.scene.info import read_header
from ultragray_service.cli.options import FieldsOf, with_options
from ultragray_service.cli.sweeps import SweepArgument, check_scene_fits, check_source, read_dataset, warn_about_dataset
from ultragray_service.cli.terminal import (
    Force,
    Json,
    Threads,
    check_file,
    command_group,
    examples,
    output_option,
    tell,
)

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.learn.training import Progress
    from ultragray_studies.methods.method import FitProgress

TILT = "growing tilt"
VoxelMm = Annotated[
    float | None,
    typer.Option(
        metavar="MM", help="Side of a voxel of compounding, mm.", show_default="0.5, or what fits into memory"
    ),
]
Follow = Callable[["Progress | FitProgress"], None]


@dataclass(frozen=True)
class ReportOptions:
    """The contents of the page besides the dataset."""

    scene: Path | None
    ablations: bool
    voxel_mm: float


command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray report sweep/ -o report.html  # trains eight times: hours",
        "ultragray report sweep/ -o report.html --scene liver.ugr --no-ablations  # minutes",
    )
)
@with_options
def report(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Page to write (.html).")],
    force: Force = False,
    json: Json = False,
    scene: Annotated[
        Path | None,
        typer.Option(help="Scene file (.ugr) to report on.", show_default="one is trained"),
    ] = None,
    no_ablations: Annotated[
        bool, typer.Option("--no-ablations", help="Leave out the ablations and growing tilt: seven trainings.")
    ] = False,
    voxel_mm: VoxelMm = None,
    preset: Annotated[
        str, typer.Option(help=f"Of every training. {PRESET_MEANINGS}", rich_help_panel=TrainingConfig.__topic__)
    ] = "fast",
    threads: Threads = 0,
    *,
    settings: Annotated[dict[str, Any], FieldsOf(TrainingConfig, "steps", "max_gaussians", "seed")],
    source: SourceOptions,
) -> None:
    """The page is one self-contained HTML file: a scene, the baselines and the paper's ablations, measured alike."""
    check_file(output, [".html"], force=force)
    import ultragray_studies.report  # noqa: F401  # where its packages are missing, that is told before all the work

    config = TrainingConfig.preset(preset, **settings)
    if scene is not None:
        read_header(scene)
    check_source(sweep)

    from ultragray.learn.evaluation.baselines import affordable_voxel_mm
    from ultragray.learn.evaluation.scoring import require_frames

    if threads:
        import torch

        torch.set_num_threads(threads)
    read = read_dataset(sweep, source)
    require_frames(read.val)
    warn_about_dataset(read)
    voxel_mm = affordable_voxel_mm(read.train) if voxel_mm is None else voxel_mm
    failures = _write_report(read, config, output, ReportOptions(scene, not no_ablations, voxel_mm))
    for name, reason in failures.items():
        typer.echo(f"failed: {name}: {reason}", err=True)
    tell(f"wrote {output}", {"output": str(output), "failed": failures}, as_json=json)


def _write_report(dataset: Dataset, config: TrainingConfig, output: Path, options: ReportOptions) -> dict[str, str]:
    """The studies that could not be finished, and why; the page has the others."""
    from ultragray.files import write_whole
    from ultragray.learn.evaluation.methods import ComparisonSettings
    from ultragray.scene.gaussians import GaussianScene
    from ultragray_studies.comparison.run import SCENE, ComparisonProgress, compare_methods
    from ultragray_studies.methods.gaussians import GivenScene
    from ultragray_studies.report import (
        Failed,
        ReportContent,
        ablation_methods,
        attempt,
        baselines,
        render_report,
        scene_evaluation,
        study_tilt,
        train_and_evaluate,
    )

    given = None if options.scene is None else GaussianScene.load(options.scene)
    if given is not None:
        check_scene_fits(given.info, dataset)
    with _following() as follow, tempfile.TemporaryDirectory(prefix="ultragray-report-") as folder:
        trained = None if given is not None else train_and_evaluate(dataset, config, report=follow(SCENE))
        scene = given if trained is None else trained.scene
        assert scene is not None
        ablated = ablation_methods(config, scene.gaussian_count) if options.ablations else {}
        followed = {name: follow(name) for name in ablated}

        def advance(state: ComparisonProgress) -> None:
            if state.fit is not None:
                followed[state.method](state.fit)

        comparison = compare_methods(
            dataset,
            {
                SCENE: GivenScene(scene, 0.0 if trained is None else trained.course.seconds),
                **baselines(options.voxel_mm),
                **ablated,
            },
            ComparisonSettings(seed=config.seed),
            folder=Path(folder),
            report=advance,
        )
        assert comparison is not None  # nothing tells it to stop
        scene_evaluation(comparison)
        tilt = None
        if options.ablations:
            tilt = attempt(partial(study_tilt, dataset.train, config, voxel_mm=options.voxel_mm, report=follow(TILT)))
        content = ReportContent(
            dataset,
            scene,
            comparison,
            Path(folder),
            course=None if trained is None else trained.course,
            ablations=tuple(ablated),
            tilt=tilt,
        )
        write_whole(output, render_report(content))
    return {**comparison.failures, **({TILT: tilt.reason} if isinstance(tilt, Failed) else {})}


@contextlib.contextmanager
def _following() -> Iterator[Callable[[str], Follow]]:
    """A bar for each training on a terminal's stderr; elsewhere one line when it begins."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:

        def follow(name: str) -> Follow:
            task: list[TaskID] = []  # made by the first step: a study that is left out shows nothing

            def advance(state: Progress | FitProgress) -> None:
                if not task:
                    task.append(bars.add_task(name))
                    if not console.is_terminal:
                        console.print(f"training: {name}", highlight=False)
                bars.update(task[0], completed=state.step, total=state.steps)

            return advance

        yield follow
