"""`ultragray report`: a scene, the baselines and the ablations on one page."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.scene_info import read_header
from ultragray.training.config import PRESET_MEANINGS, TrainingConfig

from ..options import FieldsOf, with_options
from ..output import check_file
from ..progress import working
from ..style import Force, Json, Threads, command_group, examples, output_option, tell
from ..sweeps.source import SweepArgument, check_scene_fits, check_source, read_dataset, warn_about_dataset

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray.training import Progress

TILT = "growing tilt"
VoxelMm = Annotated[
    float | None,
    typer.Option(
        metavar="MM", help="Side of a voxel of compounding, mm.", show_default="0.5, or what fits into memory"
    ),
]
Follow = Callable[["Progress"], None]


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
    import ultragray.report.page  # noqa: F401  # where its packages are missing, that is told before all the work

    config = TrainingConfig.preset(preset, **settings)
    if scene is not None:
        read_header(scene)
    check_source(sweep)

    from ultragray.evaluation.compounding import affordable_voxel_mm
    from ultragray.evaluation.scoring import require_frames

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
    import torch

    from ultragray.evaluation.baselines import evaluate_baselines
    from ultragray.evaluation.scoring import evaluate
    from ultragray.files.atomic import write_whole
    from ultragray.machine import processor_name
    from ultragray.report.page import ReportContent, render_page
    from ultragray.report.study import Failed, ablations, attempt, study_tilt, train_and_evaluate
    from ultragray.scene import GaussianScene

    scene = None if options.scene is None else GaussianScene.load(options.scene)
    if scene is not None:
        check_scene_fits(scene.info, dataset)
    with working("measuring the baselines …"):
        baselines = evaluate_baselines(dataset, voxel_mm=options.voxel_mm)
    with _following() as follow:
        content: dict[str, Any] = {}
        if scene is None:
            trained = train_and_evaluate(dataset, config, report=follow("scene"))
            content |= {"trained": trained, "scene": trained.scene, "evaluation": trained.evaluation}
        else:
            content |= {"scene": scene, "evaluation": evaluate(scene, dataset.val)}
        if options.ablations:
            content["ablations"] = {
                name: attempt(partial(train_and_evaluate, dataset, changed, report=follow(name)))
                for name, changed in ablations(config, content["scene"].gaussian_count).items()
            }
            content["tilt"] = attempt(
                partial(study_tilt, dataset.train, config, voxel_mm=options.voxel_mm, report=follow(TILT))
            )
    machine = f"{processor_name()}, {torch.get_num_threads()} threads"
    page = render_page(
        ReportContent(dataset=dataset, baselines=baselines, voxel_mm=options.voxel_mm, machine=machine, **content)
    )
    write_whole(output, page)
    studies = {**content.get("ablations", {}), TILT: content.get("tilt")}
    return {name: study.reason for name, study in studies.items() if isinstance(study, Failed)}


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

            def advance(state: Progress) -> None:
                if not task:
                    task.append(bars.add_task(name))
                    if not console.is_terminal:
                        console.print(f"training: {name}", highlight=False)
                bars.update(task[0], completed=state.step, total=state.steps)

            return advance

        yield follow
