"""`ultragray report`: a scene, the baselines and the ablations on one page."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.errors import DatasetInvalid
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
    progress_bars,
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
    failures = _write_report(read, config, output, scene, voxel_mm, ablations=not no_ablations)
    for name, reason in failures.items():
        typer.echo(f"failed: {name}: {reason}", err=True)
    tell(f"wrote {output}", {"output": str(output), "failed": failures}, as_json=json)


def _write_report(
    dataset: Dataset, config: TrainingConfig, output: Path, scene_file: Path | None, voxel_mm: float, *, ablations: bool
) -> dict[str, str]:
    """The studies that could not be finished, and why; the page has the others."""
    from ultragray.files import write_whole
    from ultragray.learn.evaluation.methods import ComparisonSettings
    from ultragray.scene.gaussians import GaussianScene
    from ultragray_studies import report as study
    from ultragray_studies.comparison.run import SCENE, compare_methods
    from ultragray_studies.methods.gaussians import GivenScene

    if scene_file is not None:
        scene, course = GaussianScene.load(scene_file), None
        check_scene_fits(scene.info, dataset)
    with _progress_bars() as follow, tempfile.TemporaryDirectory(prefix="ultragray-report-") as name:
        folder = Path(name)
        if scene_file is None:
            trained = study.train_and_evaluate(dataset, config, report=partial(follow, SCENE))
            scene, course = trained.scene, trained.course
        ablated = study.ablation_methods(config, scene.gaussian_count) if ablations else {}
        method = GivenScene(scene, 0.0 if course is None else course.seconds)
        comparison = compare_methods(
            dataset,
            {SCENE: method, **study.baselines(voxel_mm), **ablated},
            ComparisonSettings(seed=config.seed),
            folder=folder,
            report=lambda state: None if state.fit is None else follow(state.method, state.fit),
        )
        assert comparison is not None  # nothing tells it to stop
        if (reason := comparison.failures.get(SCENE)) is not None:
            raise DatasetInvalid(f"{dataset.name}: the scene cannot be measured on it: {reason}")
        tilt = None
        if ablations:
            of_tilts = partial(study.study_tilt, dataset.train, config, voxel_mm=voxel_mm)
            tilt = study.attempt(lambda: of_tilts(report=partial(follow, TILT)))
        content = study.ReportContent(dataset, scene, comparison, folder, course, tuple(ablated), tilt)
        write_whole(output, study.render_report(content))
    return {**comparison.failures, **({TILT: tilt.reason} if isinstance(tilt, study.Failed) else {})}


@contextlib.contextmanager
def _progress_bars() -> Iterator[Callable[[str, Progress | FitProgress], None]]:
    """A bar for each training on a terminal's stderr; elsewhere one line when it begins."""
    with progress_bars("{task.description}", "bar", "of", "left") as bars:
        tasks: dict[str, Any] = {}

        def follow(name: str, state: Progress | FitProgress) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name)
                if not bars.console.is_terminal:
                    bars.console.print(f"training: {name}", highlight=False)
            bars.update(tasks[name], completed=state.step, total=state.steps)

        yield follow
