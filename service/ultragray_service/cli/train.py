"""`ultragray train`: a sweep becomes a scene file; the run can be stopped and resumed."""

from __future__ import annotations

import contextlib
import json as json_text
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.errors import MemoryExceeded, TrainingDiverged, TrainingStateInvalid
from ultragray.learn.training.config import PRESET_MEANINGS, TrainingConfig, read_config_file
from ultragray.scene.info import read_header
from ultragray_service.cli.app import INTERRUPTED
from ultragray_service.cli.options import FieldsOf, parse_settings, with_options
from ultragray_service.cli.sweeps import SweepArgument, check_source, read_dataset, warn_about_dataset
from ultragray_service.cli.terminal import (
    COMPUTE,
    SCENE_SUFFIX,
    Backend,
    Force,
    Json,
    Threads,
    check_file,
    minutes_and_seconds,
    option,
    output_option,
    progress_bars,
    single,
    stop_on_signal,
    tell,
)

if TYPE_CHECKING:
    from ultragray.learn.training import Progress
    from ultragray.scene.gaussians import GaussianScene


RUN = "Run"
MEASURING = "measuring what was reached"
METRIC_NAMES = {"psnr_db": "PSNR, dB", "ms_ssim": "MS-SSIM", "gms": "GMS", "gmsd": "GMSD"}


@single(
    "ultragray train sweep/ -o liver.ugr",
    "ultragray train sweep/ -o liver.ugr --preset best --threads 8",
    "ultragray train scan.igs.mha --device-set plus.xml -o liver.ugr --set steps=4000 --set sh_degree=2",
    "ultragray train sweep/ -o liver.ugr --resume  # after Ctrl-C",
)
@with_options
def train(
    sweep: SweepArgument,
    output: Annotated[Path, output_option("Scene file to write (.ugr).")],
    force: Force = False,
    json: Json = False,
    preset: Annotated[str | None, option(PRESET_MEANINGS, shown="fast", panel=RUN)] = None,
    config: Annotated[
        Path | None, option("TOML file of settings: any field of TrainingConfig, and preset.", shown=False, panel=RUN)
    ] = None,
    setting: Annotated[
        list[str] | None,
        option("Any field of TrainingConfig; repeat.", "--set", metavar="NAME=VALUE", shown=False, panel=RUN),
    ] = None,
    start_scene: Annotated[
        Path | None,
        option("Scene file to begin with, such as one of `ultragray from-labels`.", shown=False, panel=RUN),
    ] = None,
    folder: Annotated[
        Path | None, option("Folder of the run: checkpoint, metrics.jsonl, config.json.", shown="OUTPUT.run", panel=RUN)
    ] = None,
    resume: Annotated[bool, option("Go on from the checkpoint in the run's folder.", "--resume", panel=RUN)] = False,
    checkpoint_every: Annotated[
        float, option("How often a checkpoint is written.", metavar="SECONDS", min=0.0, panel=RUN)
    ] = 30.0,
    tensorboard: Annotated[bool, option("Also write TensorBoard events.", "--tensorboard", panel=RUN)] = False,
    device: Annotated[str, option("cpu, or a GPU: cuda, or cuda:N for one of several.", panel=COMPUTE)] = "cpu",
    backend: Backend = "auto",
    threads: Threads = 0,
    *,
    settings: Annotated[dict[str, Any], FieldsOf(TrainingConfig)],
    source: SourceOptions,
) -> None:
    """Ctrl-C leaves a usable scene, and --resume goes on. Frames are held out to measure the scene with."""
    values = {
        **({} if config is None else read_config_file(config)),
        **parse_settings(setting or []),
        **settings,
        **({} if preset is None else {"preset": preset}),
    }
    check_source(sweep)
    run = RunOptions(
        output=output,
        folder=folder or output.with_name(f"{output.name}.run"),
        resume=resume,
        checkpoint_interval_s=checkpoint_every,
        tensorboard=tensorboard,
        device=device,
        backend=backend,
        start_scene=start_scene,
    )
    if start_scene is not None:
        read_header(start_scene)
    if resume:
        _check_resumable(run)
    elif not force and run.checkpoint is not None:
        raise TrainingStateInvalid(
            f"{run.folder}: there is an unfinished run: --resume continues it, --force begins anew"
        )
    check_file(output, [SCENE_SUFFIX], force=force or resume)
    chosen = _config_of(run, values)

    from ultragray.learn.training.memory import training_device

    training_device(device, backend)  # refused before the sweep is read, which may take long
    if threads:
        import torch

        torch.set_num_threads(threads)
    dataset = read_dataset(sweep, source)
    warn_about_dataset(dataset)
    if not resume and run.checkpoint is not None:
        run.checkpoint.unlink()
    _train(dataset, chosen, run, as_json=json)


@dataclass(frozen=True)
class RunOptions:
    output: Path
    folder: Path
    resume: bool
    checkpoint_interval_s: float
    tensorboard: bool
    device: str
    backend: str
    start_scene: Path | None

    @property
    def checkpoint(self) -> Path | None:
        """The file to go on from; None: there is none."""
        if not self.folder.is_dir():
            return None
        from ultragray.learn.training.trainer import CHECKPOINT_FILE

        return path if (path := self.folder / CHECKPOINT_FILE).exists() else None


def _check_resumable(run: RunOptions) -> None:
    if not run.folder.is_dir():
        raise TrainingStateInvalid(f"{run.folder}: no such folder, so there is no checkpoint to resume from")
    if run.checkpoint is not None:
        return
    from ultragray.learn.training.trainer import CONFIG_FILE, JOURNAL_FILE

    steps = last_step = None
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # whatever is there is no finished run
        steps = json_text.loads((run.folder / CONFIG_FILE).read_text(encoding="utf-8"))["steps"]
        last_line = (run.folder / JOURNAL_FILE).read_text(encoding="utf-8").splitlines()[-1]
        last_step = json_text.loads(last_line)["step"]
    if steps is not None and last_step == steps:
        raise TrainingStateInvalid(f"{run.folder}: the run is finished, all {steps} steps are done; nothing to resume")
    raise TrainingStateInvalid(f"{run.folder}: no checkpoint to resume from; leave out --resume to begin a run")


def _config_of(run: RunOptions, options: Mapping[str, Any]) -> TrainingConfig:
    """The preset with what was given; of a resumed run the one it was begun with, and what was given again."""
    values = dict(options)
    preset = values.pop("preset", None)
    if run.resume and preset is None and run.checkpoint is not None:
        from ultragray.learn.training.checkpointing import read_checkpoint_header

        stored = read_checkpoint_header(run.checkpoint).config
        return TrainingConfig.from_dict({**stored.to_dict(), **values})
    return TrainingConfig.preset(preset or "fast", **values)


def _train(dataset: Any, config: TrainingConfig, run: RunOptions, *, as_json: bool) -> None:
    from ultragray import GaussianScene
    from ultragray.learn.training import train as train_scene
    from ultragray.learn.training.run import scene_of_checkpoint

    started = time.monotonic()
    last: Progress | None = None
    with stop_on_signal() as should_stop:
        try:
            with _progress_bar() as show:

                def report(state: Progress) -> None:
                    nonlocal last
                    last = state
                    show(state)

                scene = train_scene(
                    dataset,
                    config,
                    start=None if run.start_scene is None else GaussianScene.load(run.start_scene),
                    folder=run.folder,
                    resume=run.resume,
                    report=report,
                    should_stop=should_stop,
                    device=run.device,
                    backend=run.backend,
                    checkpoint_interval_s=run.checkpoint_interval_s,
                    tensorboard=run.tensorboard,
                )
        except (TrainingDiverged, MemoryExceeded) as error:
            if run.checkpoint is None:
                raise
            scene = scene_of_checkpoint(dataset, run.folder)
            scene.save(run.output)
            step = scene.info.training["step"]
            raise type(error)(
                f"{error.detail}; {run.output} is the scene after step {step}", field=error.field
            ) from error
        scene.save(run.output)
    elapsed_s = time.monotonic() - started
    done, steps = scene.info.training["step"], scene.info.training["steps"]
    if done < steps:
        if done:
            sentence = (
                f"stopped after step {done:,} of {steps:,}; wrote {run.output} as it is; go on with the same command "
                "and --resume"
            )
        else:
            sentence = (
                f"stopped before the first step, while the effort was chosen; wrote {run.output} as it starts; the "
                "same command with --force goes on with the choice"
            )
        typer.echo(sentence, err=True)
        raise typer.Exit(INTERRUPTED)
    if (checkpoint := run.checkpoint) is not None:
        checkpoint.unlink()
    if not as_json:
        _print_metrics(scene)
    cost = ""
    if last is not None:
        memory = "" if last.peak_memory_mb is None else f", at most {last.peak_memory_mb:,.0f} MB of the GPU"
        cost = f" ({1000.0 / last.steps_per_s:.1f} ms a step{memory})"
    effort = f"chose effort {scene.info.training['effort']:g}, " if config.effort is None else ""
    tell(
        f"{effort}wrote {run.output}: {scene.gaussian_count:,} Gaussians, {done:,} steps, {elapsed_s:.0f} s{cost}",
        {
            "output": str(run.output),
            "folder": str(run.folder),
            "gaussian_count": scene.gaussian_count,
            "steps": done,
            "seconds": round(elapsed_s, 1),
            "metrics": scene.info.metrics,
            "training": scene.info.training,
        },
        as_json=as_json,
    )


@contextlib.contextmanager
def _progress_bar() -> Iterator[Callable[[Any], None]]:
    """A bar with rate, loss and time left on a terminal's stderr; elsewhere a line for every tenth of the run.

    After the last step of a training what it reached is measured, which takes a while and has no steps.
    """
    with progress_bars("{task.fields[stage]}", "bar", "of", "{task.fields[figures]}") as bar:
        task = bar.add_task("", total=None, stage="training", figures="")

        def report(state: Any) -> None:
            stage, is_last = state.beside or "training", state.step == state.steps
            if not bar.disable:
                bar.update(task, completed=state.step, total=state.steps, stage=stage, figures=_figures(state))
                if is_last:
                    bar.update(task, total=None, stage=f"{stage}: {MEASURING}", figures="")
                return
            if state.step * 10 // state.steps > (state.step - 1) * 10 // state.steps:
                prefix = f"{state.beside}: " if state.beside else ""
                sys.stderr.write(f"{prefix}step {state.step:,} of {state.steps:,}: {_figures(state)}\n")
            if is_last:
                sys.stderr.write(f"{stage}: {MEASURING} …\n")

        yield report


def _figures(state: Any) -> str:
    held_out = "" if state.val_psnr_db is None else f" · held out {state.val_psnr_db:.2f} dB"
    return (
        f"loss {state.loss:.4f} · {state.gaussian_count:,} Gaussians · {state.steps_per_s:.1f} steps/s · "
        f"{minutes_and_seconds(state.seconds_left)} left{held_out}"
    )


def _print_metrics(scene: GaussianScene) -> None:
    from rich.console import Console
    from rich.table import Table

    from ultragray.learn.report.sizes import CorrectionSizes

    metrics = scene.info.metrics
    if not metrics:
        return
    moved = CorrectionSizes.of(scene)
    is_on_path = moved is not None and scene.info.training["refine_poses"] == "path"
    table = Table("held out, on the path" if is_on_path else "held out", *(METRIC_NAMES[name] for name in metrics))
    table.add_row("mean", *(f"{value:.2f}" if name == "psnr_db" else f"{value:.3f}" for name, value in metrics.items()))
    Console().print(table)
    if moved is not None:
        typer.echo(str(moved))
