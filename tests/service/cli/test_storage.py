"""`ultragray storage copy`: an installation's scenes and datasets into a bucket."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.storage.location import open_storage

from ...workers.jobs.conftest import store_dataset
from .command_line import run


def test_an_installation_goes_into_a_bucket(tmp_path: Path, new_bucket: Callable[[], str]) -> None:
    data, bucket = tmp_path / "data", new_bucket()
    store_dataset(data / "artifacts", "tiny")
    copy_demo_scene(data / "demo.ugr")
    result = run("storage", "copy", data, bucket)
    assert (result.exit_code, result.stdout.count("1 copied")) == (0, 2), result.output
    keys = {entry.key for entry in open_storage(bucket).entries()}
    assert {"demo.ugr", "artifacts/datasets/tiny.json"} < keys
    again = json.loads(run("storage", "copy", data, bucket, "--json").stdout)
    assert (again["scenes"], again["datasets"]) == (0, 0)
    assert (again["already_there"], again["datasets_already_there"]) == (1, 1)
