"""The work of a comparison: every method fitted and scored. Interrupted, it goes on with the method at hand."""

from __future__ import annotations

import math
import shutil
import sys
from dataclasses import replace

from ultragray.errors import TrainingDiverged
from ultragray_studies.comparison.page import write_comparison
from ultragray_studies.comparison.run import ComparisonProgress, compare_methods
from ultragray_studies.methods.registry import chosen_methods
from ultragray_workers.jobs.kinds.evaluate import CompareJob
from ultragray_workers.jobs.progress import Outcome, Progress
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped

_LINES = 10  # of the log in a fit


def run(job_run: JobRun, job: CompareJob) -> Outcome:
    """Compares the methods, or goes on where an earlier process was, and completes the artifacts.

    A method that fails is a row that says why. Raises TrainingDiverged where none comes to its end, Stopped,
    DatasetNotFound, DatasetInvalid also for a dataset without held-out frames, TrainingStateInvalid.
    """
    device = job_run.request.device
    dataset = job_run.load_dataset(job.dataset)
    sys.stderr.write(
        f"comparing {', '.join(job.methods)} on {job.dataset} on {device}, {job_run.request.threads} threads\n"
    )
    comparison = compare_methods(
        dataset,
        chosen_methods(job.methods),
        job,
        folder=job_run.folder.run,
        device=device,
        report=lambda state: _report(job_run, state),
        should_stop=job_run.should_stop,
    )
    if comparison is None:
        raise Stopped
    for name, reason in comparison.failures.items():
        sys.stderr.write(f"{name} failed: {reason}\n")
    if not comparison.measured:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in comparison.failures.items())
        raise TrainingDiverged(f"no method came to its end: {reasons}")
    metrics = {
        f"{name}_{metric}": value
        for name, evaluation in comparison.measured.items()
        for metric, value in evaluation.mean.to_dict().items()
    }
    with job_run.folder.new_artifacts() as folder:
        for path in write_comparison(comparison, dataset, job_run.folder.run):
            shutil.copyfile(path, folder / path.name)
    return Outcome(artifacts=job_run.folder.artifact_names(), metrics=metrics)


def _report(job_run: JobRun, state: ComparisonProgress) -> None:
    fit = state.fit
    at = Progress(method=state.method, method_number=state.number, methods=state.of)
    if fit is None:
        job_run.report(at)
        sys.stderr.write(f"{state.method}, method {state.number} of {state.of}\n")
    else:
        left_s = fit.seconds_left if math.isfinite(fit.seconds_left) else None
        job_run.report(replace(at, step=fit.step, steps=fit.steps, loss=fit.loss, seconds_left=left_s))
        if fit.ends_part(_LINES):
            sys.stderr.write(f"{state.method}: step {fit.step:,} of {fit.steps:,}: loss {fit.loss:.4f}\n")
    sys.stderr.flush()
