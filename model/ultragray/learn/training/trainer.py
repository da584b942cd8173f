"""Trainer: one run of a training, step by step, with its checkpoints."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from ultragray.errors import DatasetInvalid, MemoryExceeded, TrainingDiverged, TrainingStateInvalid
from ultragray.files import remove_stale_temporaries, write_whole
from ultragray.learn.evaluation.scoring import evaluate
from ultragray.learn.sweep import Dataset, spread_places
from ultragray.learn.synthesis.refinement import started_parameters
from ultragray.learn.training.batch import Batch
from ultragray.learn.training.beam import TrainedBeam
from ultragray.learn.training.between import ViewsBetween, neighbours_of
from ultragray.learn.training.checkpointing import (
    CheckpointHeader,
    check_same_run,
    check_tensors,
    read_checkpoint,
    write_checkpoint,
)
from ultragray.learn.training.config import TrainingConfig
from ultragray.learn.training.geometry import BatchSampler, Geometry, Shadows
from ultragray.learn.training.initial import Start, initial_parameters
from ultragray.learn.training.intensity import least_sh0, project_sh0
from ultragray.learn.training.losses import SSIM_WINDOW
from ultragray.learn.training.memory import (
    check_comparison_memory,
    check_memory,
    forget_peak_memory,
    peak_memory_mb,
    training_device,
)
from ultragray.learn.training.optimizer import Optimizer, PullStatistics, Schedule, is_trained, refine
from ultragray.learn.training.pictures import write_picture
from ultragray.learn.training.poses import PoseRefinement
from ultragray.learn.training.progress import Board, Journal, Progress, StepTimer
from ultragray.rendering.backends.registry import choose_backend
from ultragray.rendering.frames import Frames, render
from ultragray.scene.gaussians import PARAMETERS, GaussianScene, no_smaller_than_held
from ultragray.scene.info import SceneInfo, check_training_pose_count

CHECKPOINT_FILE = "checkpoint.safetensors"
JOURNAL_FILE = "metrics.jsonl"
CONFIG_FILE = "config.json"
STEPS_PER_CHECK = 100  # of the parameters being finite; the loss is looked at after every step
VALIDATIONS = 20  # in a run; the peak of a GPU's memory is noted as often
VALIDATION_FRAMES = 8

Log: TypeAlias = Callable[[dict[str, float]], object]


class Trainer:
    """One run: its parameters and everything that changes with them."""

    def __init__(
        self,
        dataset: Dataset,
        config: TrainingConfig,
        *,
        folder: Path | None,
        device: str,
        backend: str,
        start: GaussianScene | None = None,
    ) -> None:
        if start is not None:
            most = max(start.gaussian_count, config.max_gaussians or 0)
            config = replace(config, initial_gaussians=start.gaussian_count, max_gaussians=most)
        self._device = training_device(device, backend)
        if min(dataset.train.height, dataset.train.width) < SSIM_WINDOW:
            raise DatasetInvalid(
                f"{dataset.train.source}: images must have at least {SSIM_WINDOW} rows and columns, got "
                f"{dataset.train.height}x{dataset.train.width}"
            )
        check_training_pose_count(len(dataset.train))
        check_comparison_memory(dataset, config)
        self._dataset_sha256 = dataset.sha256
        self.refinement = PoseRefinement.of(dataset, config.refine_poses)
        dataset = self.refinement.dataset
        self._geometry = Geometry.of(dataset)
        config = config.resolved(self._geometry)
        check_memory(dataset, config, self._device)
        self.dataset, self.config, self.folder = dataset, config, folder
        self._checkpoint = None if folder is None else folder / CHECKPOINT_FILE
        forget_peak_memory(self._device)
        self._images = torch.tensor(dataset.train.images, device=self._device)  # [F, H, W] uint8
        self._info = SceneInfo(
            centre_mm=self._geometry.centre_mm.tolist(),
            probe=dataset.probe,
            image_height=dataset.train.height,
            image_width=dataset.train.width,
            intensity=config.intensity,
            dataset_name=dataset.name,
            dataset_sha256=self._dataset_sha256,
        )
        self._generator = torch.Generator().manual_seed(config.seed)
        neighbours = neighbours_of(dataset.train)
        if not config.views_between:
            neighbours = neighbours.without_ends()  # nothing would train what begins there
        assert config.views_between is not None
        self._between_count = round(config.views_between * config.batch_size)
        self._views_between = ViewsBetween(dataset.train, neighbours, self._images) if self._between_count else None
        self._sampler = BatchSampler(len(dataset.train), config.batch_size - self._between_count, self._generator)
        self._batch_size = self._sampler.batch_size + self._between_count
        self._schedule = Schedule(config, scene_scale_cm=self._geometry.scene_scale_cm, batch_size=self._batch_size)
        self._beam = TrainedBeam(config, dataset.probe)
        self.step = 0  # steps done
        self._timer = StepTimer()
        self._val_psnr_db: float | None = None
        self._val_step: int | None = None
        self._peak_memory_mb: float | None = None
        needs_shadows = config.transmittance and (config.start == "informed" or config.absorption_penalty > 0.0)
        shadows = Shadows(dataset.train) if needs_shadows else None
        if start is None:
            begin = initial_parameters(dataset, neighbours, shadows, self._geometry, config, self._generator)
        else:
            parameters = started_parameters(start, config, self._geometry.centre_mm)
            begin = Start(parameters, torch.zeros(start.gaussian_count))
        self._shadowed: Tensor | None = None  # [F, H, W] pixels in which absorption has no price
        if shadows is not None and config.absorption_penalty:
            self._shadowed = torch.from_numpy(shadows.pixels()).to(self._device)
        self._begin_with(begin.parameters, begin.floor)
        self._backend = choose_backend(backend, self._view(sh_degree=0))

    def _begin_with(self, parameters: dict[str, Tensor], floor: Tensor) -> None:  # [N]
        self.parameters = self._trainable(parameters)
        self._floor = floor.to(self._device)
        self._least_sh0 = least_sh0(self._floor, self.config.intensity)
        self._optimizer = Optimizer(
            self.parameters, batch_size=self._batch_size, scale_penalty=self.config.scale_penalty
        )
        self._pull = PullStatistics.empty(len(parameters["means"]), self._device)

    def _trainable(self, parameters: dict[str, Tensor]) -> dict[str, Tensor]:
        return {
            name: tensor.detach().to(self._device).requires_grad_(is_trained(name, tensor.shape, self.config))
            for name, tensor in parameters.items()
        }

    @contextlib.contextmanager
    def logs(self, tensorboard: bool) -> Iterator[Log]:
        """The sink of each step's metrics: the files of the run's folder, where it has one."""
        if self.folder is None:
            yield lambda line: None
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        for name in (CHECKPOINT_FILE, JOURNAL_FILE, CONFIG_FILE):
            remove_stale_temporaries(self.folder / name)
        write_whole(self.folder / CONFIG_FILE, json.dumps(self.config.to_dict(), indent=2) + "\n")
        with contextlib.ExitStack() as stack:
            journal = Journal(self.folder / JOURNAL_FILE, steps_done=self.step)
            sinks: list[Journal | Board] = [stack.enter_context(contextlib.closing(journal))]
            if tensorboard:
                sinks.append(stack.enter_context(contextlib.closing(Board(self.folder, steps_done=self.step))))
            yield lambda line: [sink.write(line) for sink in sinks]

    @contextlib.contextmanager
    def running_out_of_memory_explained(self) -> Iterator[None]:
        """Raises MemoryExceeded, saying what to lower and what is kept, where the device's memory does not suffice."""
        try:
            yield
        except (torch.OutOfMemoryError, MemoryExceeded) as error:
            raise MemoryExceeded(
                f"the memory of {self._device} did not suffice after step {self.step:,} with {self.gaussian_count:,} "
                f"Gaussians and batches of {self._batch_size} frames of {self.dataset.train.height}x"
                f"{self.dataset.train.width}: lower max_gaussians or batch_size{self._kept()}",
                field="max_gaussians",
            ) from error

    def run(
        self,
        log: Log,
        report: Callable[[Progress], None] | None,
        should_stop: Callable[[], bool] | None,
        checkpoint_interval_s: float,
    ) -> None:
        saved_at = time.monotonic()
        while self.step < self._schedule.steps:
            progress = self._timed_step(log)
            if report is not None:
                report(progress)
            if should_stop is not None and should_stop():
                break
            if self.step < self._schedule.steps and time.monotonic() - saved_at >= checkpoint_interval_s:
                self.save_checkpoint()
                saved_at = time.monotonic()
        self.save_checkpoint()

    def _timed_step(self, log: Log) -> Progress:
        started = time.perf_counter()
        loss = self.take_step()
        line: dict[str, float] = {"step": self.step, "loss": loss, "gaussians": self.gaussian_count}
        if self.step % math.ceil(self._schedule.steps / VALIDATIONS) == 0:
            if len(self.dataset.val):
                self._val_psnr_db = line["val_psnr_db"] = self._validate()
                self._val_step = self.step
            self._peak_memory_mb = peak_memory_mb(self._device)
            if self._peak_memory_mb is not None:
                line["peak_memory_mb"] = round(self._peak_memory_mb, 1)
        self._timer.add(time.perf_counter() - started)
        log({**line, "elapsed_s": round(self._timer.elapsed_s, 3)})
        rate = self._timer.rate()
        return Progress(
            step=self.step,
            steps=self._schedule.steps,
            loss=loss,
            gaussian_count=self.gaussian_count,
            steps_per_s=rate,
            seconds_left=(self._schedule.steps - self.step) / rate if rate else math.inf,
            val_psnr_db=self._val_psnr_db,
            val_step=self._val_step,
            peak_memory_mb=self._peak_memory_mb,
        )

    @property
    def is_finished(self) -> bool:
        return self.step == self._schedule.steps

    @property
    def gaussian_count(self) -> int:
        return len(self.parameters["means"])

    def take_step(self) -> float:
        """One batch, one update, and the refinement that is due after it; returns the loss."""
        own, config = self._sampler.next_batch(), self.config
        between = self._views_between
        batch = Batch.of(self.dataset.train, self._images, own, between, self._between_count, config, self._generator)
        poses = self.refinement.corrected(batch.nearest, batch.poses)
        image = batch.loss(self._rendered(poses, self._schedule.sh_degree(self.step)), self._shadowed, config)
        image.backward()  # type: ignore[no-untyped-call]
        self.refinement.step(self.step / self._schedule.steps)
        with torch.no_grad():
            if self.config.refinements:
                means_gradient = self.parameters["means"].grad
                assert means_gradient is not None
                self._pull.add(means_gradient)
            penalty = self._optimizer.step(self._schedule.rates(self.step))
            self._beam.step(self.step / self._schedule.steps)
            self._project(self.parameters["sh0"])
            both = (image.detach() + penalty)[None]
            loss = float(both.tolist()[0])  # waits for a GPU: all work of the step is queued by now
        if not math.isfinite(loss):
            raise self._diverged(self.step + 1, f"the loss is {loss}")
        self.step += 1
        if self.step % STEPS_PER_CHECK == 0:
            self._check_finite()
        due = self._schedule.refinement(self.step)
        if due is not None:
            self._refine(self._schedule.gaussian_limit(due))
        return loss

    def _rendered(self, poses: Any, sh_degree: int) -> Frames:  # [C, 4, 4] mm -> [C, H, W] each
        scene = self._view(sh_degree)
        sweep = self.dataset.train
        return render(
            scene,
            self.dataset.probe,
            poses,
            height=sweep.height,
            width=sweep.width,
            outputs=("bmode",) if self._shadowed is None else ("bmode", "transmittance"),
            backend=self._backend,
            beam=self._beam.numbers,
        )

    def _view(self, sh_degree: int) -> GaussianScene:
        """The parameters as a scene, without the checks of `from_splats`, which read every value."""
        harmonics = (sh_degree + 1) ** 2 - 1
        tensors: dict[str, Any] = {**self.parameters, "shN": self.parameters["shN"][:, :harmonics]}
        info = replace(self._info, sh_degree=sh_degree, gaussian_count=self.gaussian_count)
        return GaussianScene(**tensors, info=info)

    def _project(self, sh0: Tensor) -> None:
        project_sh0(sh0, self.config.intensity, self._least_sh0 if self._schedule.has_floor(self.step) else None)

    def _refine(self, limit: int) -> None:
        with torch.no_grad():
            refined = refine(
                self.parameters,
                self._pull.mean(),
                limit=limit,
                scene_scale_cm=self._geometry.scene_scale_cm,
                config=self.config,
                generator=self._generator,
            )
            if not len(refined.parameters["means"]):
                raise self._diverged(self.step, "refinement pruned every Gaussian")
            self._floor = self._floor[refined.parent]
            self._least_sh0 = least_sh0(self._floor, self.config.intensity)
            self._project(refined.parameters["sh0"])
        self.parameters = self._trainable(refined.parameters)
        self._optimizer.replace(self.parameters, refined.origin)
        self._pull = PullStatistics.empty(self.gaussian_count, self._device)

    def _check_finite(self) -> None:
        tensors = {
            **self.parameters,
            **{f"pose corrections ({name})": tensor for name, tensor in self.refinement.tensors().items()},
            **{f"numbers of the beam ({name})": tensor for name, tensor in self._beam.tensors().items()},
        }
        finite = torch.stack([torch.isfinite(t.detach()).all().to(self._device) for t in tensors.values()]).tolist()
        for name, is_finite in zip(tensors, finite, strict=True):
            if not is_finite:
                raise self._diverged(self.step, f"{name} are no longer finite")

    def _diverged(self, step: int, what: str) -> TrainingDiverged:  # step: from 1
        return TrainingDiverged(f"training diverged in step {step}: {what}{self._kept()}")

    def _kept(self) -> str:
        path = self._checkpoint
        return f"; the last good checkpoint is kept in {path}" if path is not None and path.exists() else ""

    def _validate(self) -> float:
        """Mean PSNR over some of the held-out frames, dB."""
        val = self.dataset.val.select(spread_places(len(self.dataset.val), VALIDATION_FRAMES))
        truth = torch.tensor(val.images, device=self._device).float().div_(255.0)
        with torch.no_grad():
            rendered = self._rendered(val.poses, self._schedule.sh_degree(self.step))["bmode"]
            if self.folder is not None:
                middle = len(val) // 2
                picture = rendered[middle].clamp(0.0, 1.0).cpu().numpy()
                write_picture(self.folder, self.step, val.select([middle]), picture)
            errors = (rendered - truth).square().mean(dim=(1, 2)).clamp(min=1e-10)
            return float((-10.0 * errors.log10()).mean())

    def save_checkpoint(self) -> None:
        """Writes what a resumed run needs, where the run has a folder. Raises TrainingDiverged rather than keep NaN."""
        self._check_finite()
        if self._checkpoint is None:
            return
        tensors = {
            **{f"parameter.{name}": tensor for name, tensor in self.parameters.items()},
            **{f"{part}.{name}": t for part, of in self._parts().items() for name, t in of.tensors().items()},
            "pull.total": self._pull.total,
            "pull.seen": self._pull.seen,
            "floor": self._floor,
            "waiting": self._sampler.waiting,
            "generator": self._generator.get_state(),
        }
        header = CheckpointHeader(self.step, self._timer.elapsed_s, self._dataset_sha256, self.config)
        write_checkpoint(self._checkpoint, header, tensors)

    def _parts(self) -> dict[str, Optimizer | PoseRefinement | TrainedBeam]:
        """The parts with a state of their own, by the prefix that their tensors have in a checkpoint."""
        return {"adam": self._optimizer, "pose": self.refinement, "beam": self._beam}

    def restore(self) -> None:
        """Takes over the run of the folder's checkpoint. Raises TrainingStateInvalid where it is another run's."""
        if (path := self._checkpoint) is None:
            raise TrainingStateInvalid("a run without a folder cannot be resumed")
        header, tensors = read_checkpoint(path)
        check_same_run(path, header, self.config, self._dataset_sha256)
        check_tensors(path, header, tensors, len(self.dataset.train), self.refinement.group_count)
        try:
            self._generator.set_state(tensors["generator"])
        except RuntimeError as error:
            raise TrainingStateInvalid(f"{path}: its tensor generator is no generator's state: {error}") from error
        self._begin_with({name: tensors[f"parameter.{name}"] for name in PARAMETERS}, tensors["floor"])
        for part, of in self._parts().items():
            of.load({name.removeprefix(f"{part}."): t for name, t in tensors.items() if name.startswith(f"{part}.")})
        self._pull = PullStatistics(tensors["pull.total"].to(self._device), tensors["pull.seen"].to(self._device))
        self._sampler.waiting = tensors["waiting"]
        self.step = header.step
        self._timer = StepTimer(header.elapsed_s)

    def scene(self) -> GaussianScene:
        """The scene as it is; a finished run's is measured on the held-out frames."""
        splats = {name: tensor.detach().cpu() for name, tensor in self.parameters.items()}
        if self.is_finished and self._beam.is_doubtful(self._geometry.frame_spacing_mm):
            logging.getLogger(__name__).warning(
                "the frames do not tell how thick they are: what was learned is thinner than the gaps between them; "
                "give slice_thickness_mm, or leave learn_beam off"
            )
        info = replace(
            self._info,
            beam=self._beam.found(),
            training={**self.config.to_dict(), "step": self.step},
            tissue_shares=self.refinement.tissue_shares,
        )
        scene = GaussianScene.from_splats(no_smaller_than_held(splats), info=info, **self.refinement.of_scene())
        if len(self.dataset.val) and self.is_finished:
            measured = evaluate(scene.at_rest().to(self._device), self.dataset.val, backend=self._backend)
            scene.info.metrics.update(measured.mean.to_dict())
        return scene
