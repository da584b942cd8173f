"""`ultragray bench --backend cuda --train`: a training step on a GPU, its parts and its memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from ultragray.learn.training.memory import forget_peak_memory, peak_memory_mb
from ultragray.rendering.backends import cuda
from ultragray_service.bench.cuda.gpu import gpu_document
from ultragray_service.bench.kernel import BATCH
from ultragray_service.bench.report import Report
from ultragray_service.bench.train import PARTS, measure_training, training_scenes

STEPS = 200  # a tenth of them where it is to be quick


def run(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report, device = Report(output, quick), cuda.device()
    rows: list[dict[str, Any]] = []
    for bench in training_scenes()[1 if quick else 0 :]:
        report.tell(f"{bench.gaussian_count:,} Gaussians: training ...")
        forget_peak_memory(device)
        timing = measure_training(bench, torch.get_num_threads(), STEPS // 10 if quick else STEPS, device, "cuda")
        rows.append(
            {
                "gaussians": bench.gaussian_count,
                "images": f"{BATCH} of {bench.height}x{bench.width}",
                "step_ms": timing.wall_ms,
                "part_ms": {part: float(np.median(timing.part_ms[part])) for part in PARTS},
                "peak_memory_mb": peak_memory_mb(device),
            }
        )
    report.conclude(
        gpu_document(device, rows=rows),
        {
            "Gaussians": "{gaussians:,}",
            "images": "{images}",
            "step ms": "{step_ms:.2f}",
            **{f"{part} ms": f"{{part_ms[{part}]:.2f}}" for part in PARTS},
            "peak MB": "{peak_memory_mb:,.0f}",
        },
        rows,
    )
