from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from ultragray.errors import InvalidArgument
from ultragray_workers.jobs.specification import PoseSampler, RenderJob, TrainJob, digest, from_dict, in_short, to_dict

POSES = np.tile(np.eye(4), (3, 1, 1)).tolist()


@pytest.mark.parametrize(
    "job",
    [
        TrainJob("liver", "liver-1", preset="paper", settings={"steps": 10, "start": "random"}, device="cuda:1"),
        RenderJob("liver", poses=POSES, height=20, width=30, outputs=("echo", "bmode"), format="tar"),
        RenderJob("liver", sampler=PoseSampler("jitter", 4, 2.0, 5.0, 7)),
        RenderJob("liver", sampler=PoseSampler("training")),
    ],
)
def test_there_and_back(job: Any) -> None:
    assert from_dict(json.loads(json.dumps(to_dict(job)))) == job


def test_in_short_holds_no_poses() -> None:
    short = in_short(RenderJob("liver", poses=POSES))
    assert short["pose_count"] == 3
    assert "poses" not in short


def test_digest_tells_what_was_asked_for() -> None:
    job = TrainJob("liver", "one")
    assert digest(job, 0) == digest(TrainJob("liver", "one"), 0)
    assert len({digest(job, 0), digest(job, 1), digest(TrainJob("liver", "two"), 0)}) == 3


def train(**values: Any) -> dict[str, Any]:
    return {"kind": "train", "dataset": "liver", "scene": "one", **values}


def render(**values: Any) -> dict[str, Any]:
    return {"kind": "render", "scene": "one", "poses": POSES, **values}


def jitter(**values: Any) -> dict[str, Any]:
    return render(poses=None, sampler={"kind": "jitter", "count": 3, **values})


@pytest.mark.parametrize(
    ("document", "field"),
    [
        ({}, "kind"),
        ({"kind": "dance"}, "kind"),
        ({"kind": ["train"]}, "kind"),
        ({"kind": "train", "scene": "one"}, "dataset"),
        (train(scene="../one"), "scene"),
        (train(scene=5), "scene"),
        (train(preset="slow"), "preset"),
        (train(settings=[1]), "settings"),
        (train(settings={"steps": [1]}), "settings.steps"),
        (train(settings={"means_rate": float("nan")}), "settings.means_rate"),
        (train(device="tpu"), "device"),
        (train(poses=POSES), "poses"),
        (render(poses=None), "poses"),
        (render(sampler={"kind": "training"}), "poses"),
        (render(poses=[]), "poses"),
        (render(poses=np.full((1, 4, 4), np.nan).tolist()), "poses[0]"),
        (render(height=0), "height"),
        (render(width=True), "width"),
        (render(outputs=["colour"]), "outputs"),
        (render(outputs=[[1]]), "outputs"),
        (render(format="zip"), "format"),
        (render(poses=None, sampler=3), "sampler"),
        (render(poses=None, sampler={}), "sampler.kind"),
        (render(poses=None, sampler={"kind": "training", "count": 3}), "sampler.kind"),
        (jitter(count=0), "sampler.count"),
        (jitter(translation_mm=-1), "sampler.translation_mm"),
        (jitter(rotation_deg="much"), "sampler.rotation_deg"),
        (jitter(seed=0.5), "sampler.seed"),
        (jitter(speed=1), "sampler.speed"),
    ],
)
def test_refused_with_the_field(document: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidArgument) as caught:
        from_dict(document)
    assert caught.value.field == field
