"""`ultragray compare`: methods side by side on the same held-out frames, each within the same budget."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ultragray.datasets.source import SourceOptions
from ultragray.errors import TrainingStateInvalid
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray_service.cli.app import INTERRUPTED
from ultragray_service.cli.evaluate import print_speckle
from ultragray_service.cli.options import with_options
from ultragray_service.cli.sweeps import SweepArgument, check_source, read_dataset, warn_about_dataset
from ultragray_service.cli.terminal import (
    COMPUTE,
    Json,
    Threads,
    check_file,
    command_group,
    examples,
    output_option,
    print_table,
    progress_bars,
    stop_on_signal,
    to_json,
    wide_console,
)

if TYPE_CHECKING:
    from ultragray.datasets import Dataset
    from ultragray_studies.comparison.result import Comparison
    from ultragray_studies.comparison.run import ComparisonProgress

PAGE_SUFFIX, BESIDE_IT = ".html", (".json", ".tex")

command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray compare sweep/ --methods median,mean,linear,nearest  # seconds",
        "ultragray compare sweep/ -o comparison.html  # every method, as long as a scene takes",
        "ultragray compare sweep/ --seeds 5 -o comparison.html  # mean and deviation over five seeds, with a plot",
        "ultragray compare sweep/ --methods scene,median --json | jq '.results[].name'",
    )
)
@with_options
def compare(
    sweep: SweepArgument,
    output: Annotated[
        Path | None,
        output_option(
            "Page to write (.html), with .json and .tex beside it. What each method learned is kept in OUTPUT.run: the "
            "same command goes on from there, also with more methods.",
            default="none, only the table",
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace what is there, and begin anew.", rich_help_panel="Output")
    ] = False,
    json: Json = False,
    device: Annotated[
        str, typer.Option(help="cpu, or a GPU: cuda, or cuda:N for one of several.", rich_help_panel=COMPUTE)
    ] = "cpu",
    threads: Threads = 0,
    seeds: Annotated[
        int,
        typer.Option(
            help="How many seeds, from --seed on: figures are then mean ± standard deviation over them, and a plot "
            "with error bars (.svg) is written beside the page, which is of the first.",
            min=1,
            max=100,
            rich_help_panel=ComparisonSettings.__topic__,
        ),
    ] = 1,
    *,
    settings: ComparisonSettings,
    source: SourceOptions,
) -> None:
    """The figures are those of `ultragray eval`. Ctrl-C stops; with --output, the same command goes on."""
    check_source(sweep)
    if output is not None:
        _check_output(output, force=force)
        import ultragray_studies.comparison.page  # noqa: F401  # packages that it lacks are told before all the work

    from ultragray.learn.evaluation.scoring import require_frames
    from ultragray.learn.training.memory import training_device
    from ultragray_studies.methods.registry import chosen_methods

    training_device(device, "auto")  # refused before the sweep is read, which may take long
    if threads:
        import torch

        torch.set_num_threads(threads)
    read = read_dataset(sweep, source)
    require_frames(read.val)
    warn_about_dataset(read)
    if output is not None:
        if force:
            shutil.rmtree(run_folder(output), ignore_errors=True)
        _compare(read, settings, seeds, device, run_folder(output), output, as_json=json)
        return
    if any(method.describe().published_steps is not None for method in chosen_methods(settings.methods).values()):
        typer.echo("what the methods learn is not kept; with --output PAGE.html it is, and a page is written", err=True)
    with tempfile.TemporaryDirectory(prefix="ultragray-compare-") as folder:
        _compare(read, settings, seeds, device, Path(folder), None, as_json=json)


def run_folder(output: Path) -> Path:
    """The folder of what each method of a comparison learned."""
    return output.with_name(f"{output.name}.run")


def _check_output(output: Path, *, force: bool) -> None:
    """Raise InvalidArgument where the page or a file beside it cannot be written, or is not this comparison's to write.

    TrainingStateInvalid where the folder of the run is another thing's: --force would remove it.
    """
    from ultragray_studies.comparison.run import RUN_FILE

    run = run_folder(output)
    is_a_run = (run / RUN_FILE).is_file()
    if run.exists() and not is_a_run and not (run.is_dir() and next(run.iterdir(), None) is None):
        raise TrainingStateInvalid(f"{run}: it is there, and holds no comparison: give another --output, or move it")
    check_file(output, [PAGE_SUFFIX], force=force or is_a_run)
    for suffix in BESIDE_IT:
        check_file(output.with_suffix(suffix), force=force or is_a_run)


def _compare(
    dataset: Dataset,
    settings: ComparisonSettings,
    seeds: int,
    device: str,
    run: Path,
    output: Path | None,
    *,
    as_json: bool,
) -> None:
    from ultragray.files import write_whole
    from ultragray_studies.comparison.run import compare_methods
    from ultragray_studies.comparison.seeds import over_seeds, plot_seeds, seeds_document
    from ultragray_studies.methods.registry import chosen_methods

    at, written = "stopped before the first method", []
    comparisons: list[Comparison] = []  # by seed
    with stop_on_signal() as should_stop, _progress_bar() as show:

        def report(state: ComparisonProgress) -> None:
            nonlocal at
            at = f"stopped at {state.method}, method {state.number} of {state.of}"
            if state.fit is not None:
                at += f", after step {state.fit.step:,} of {state.fit.steps:,}"
            show(state)

        methods = chosen_methods(settings.methods)
        for seed in range(settings.seed, settings.seed + seeds):
            result = compare_methods(
                dataset,
                methods,
                replace(settings, seed=seed),
                folder=run if seed == settings.seed else run / f"seed-{seed}",
                device=device,
                report=report,
                should_stop=should_stop,
            )
            if result is None:
                break
            comparisons.append(result)
        is_whole = len(comparisons) == seeds
        if is_whole and output is not None:
            from ultragray_studies.comparison.page import write_comparison

            for file in write_comparison(comparisons[0], dataset, run):
                written.append(output.with_suffix(file.suffix))
                write_whole(written[-1], file.read_bytes())
            if seeds > 1:
                write_whole(output.with_suffix(".json"), to_json(seeds_document(comparisons)) + "\n")
                written.append(output.with_suffix(".svg"))
                write_whole(written[-1], plot_seeds(over_seeds(comparisons)))
    if not is_whole:
        typer.echo(f"{at}; {'nothing is kept' if output is None else 'go on with the same command'}", err=True)
        raise typer.Exit(INTERRUPTED)
    comparison = comparisons[0]
    if as_json:
        document = comparison.to_dict() if seeds == 1 else seeds_document(comparisons)
        typer.echo(to_json(document | {"written": written}))
    else:
        if seeds == 1:
            _print_table(comparison)
        else:
            _print_seeds(comparisons)
        if comparison.measured:
            print_speckle({one.title: one.evaluation for one in comparison.results if one.evaluation is not None})
        for path in written:
            typer.echo(f"wrote {path}")
    if not comparison.measured:
        raise typer.Exit(1)


def _print_seeds(comparisons: list[Comparison]) -> None:
    """A table of the scores of each method over all seeds: mean ± standard deviation."""
    from ultragray.learn.report.tables import METRICS, shown_value
    from ultragray_studies.comparison.seeds import over_seeds
    from ultragray_studies.comparison.tables import budget_text

    first = comparisons[0]
    rows = [
        [title, *(" ± ".join(shown_value(metric.name, value) for value in spread[metric.name]) for metric in METRICS)]
        for title, spread in over_seeds(comparisons).items()
    ]
    typer.echo(
        f"{first.dataset.name}, {first.dataset.val_frames} val frames, {len(comparisons)} seeds from {first.seed}, "
        f"{first.machine}; budget: {budget_text(first)}"
    )
    print_table(["", *(metric.label for metric in METRICS)], rows)


def _print_table(comparison: Comparison) -> None:
    """A table of the means of each method, its costs and its mean rank, and why a method has none."""
    from rich.markup import escape
    from rich.table import Table

    from ultragray.learn.report.tables import METRICS, rank, shown_value
    from ultragray_studies.comparison.tables import PATH_HEADING, budget_text, path_texts, steps_text

    table = Table(box=None, pad_edge=False)
    scores = (*(metric.label for metric in METRICS), *([PATH_HEADING] if comparison.has_path else []))
    heads = ("", *scores, "steps", "training, s", "frame, ms", "MB", "mean rank")
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    ranks = rank(comparison.measured)
    for one in comparison.results:
        if one.evaluation is not None:
            means = one.evaluation.mean.to_dict()
            table.add_row(
                escape(one.title),
                *(shown_value(metric.name, means[metric.name]) for metric in METRICS),
                *path_texts(comparison, one),
                steps_text(one),
                f"{one.cost.seconds:,.1f}",
                f"{one.frame_ms:,.1f}",
                f"{one.cost.model_bytes / 1e6:,.2f}",
                f"{ranks[one.name].mean:.2f}",
            )
    console, facts = wide_console(), comparison.dataset
    head = f"{facts.name}, {facts.val_frames} val frames, {comparison.machine}; budget: {budget_text(comparison)}"
    failures = (f"{one.title} failed: {one.failure}" for one in comparison.results if one.failure is not None)
    for part in (head, table, *failures):
        console.print(part, highlight=False, markup=False, soft_wrap=part is not table)


@contextmanager
def _progress_bar() -> Iterator[Callable[[ComparisonProgress], None]]:
    """A bar a method on a terminal's stderr; elsewhere a line for each tenth of a fit."""
    with progress_bars("{task.description}", "bar", "of", "left") as bars:
        task = bars.add_task("", total=None)

        def show(state: ComparisonProgress) -> None:
            named, fit = f"{state.method} ({state.number} of {state.of})", state.fit
            if bars.console.is_terminal:
                done, of = (None, None) if fit is None else (fit.step, fit.steps)
                bars.update(task, description=named, completed=done, total=of)
            elif fit is not None and fit.ends_part(10):
                sys.stderr.write(f"{named}: step {fit.step:,} of {fit.steps:,}: loss {fit.loss:.4f}\n")

        yield show
