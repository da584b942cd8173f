"""The Python client, as docs/interfaces.md lists it."""

from __future__ import annotations

from enum import Enum

import ultragray_client
from ultragray_client.sync import datasets as client_datasets
from ultragray_client.sync import jobs as client_jobs
from ultragray_client.sync import scenes as client_scenes
from ultragray_client.sync import workers as client_workers

from .document import call_of, table


def test_python_client() -> None:
    by_hand = [name for name in ultragray_client.__all__ if name not in ultragray_client.contract.__all__]
    named = [(name, getattr(ultragray_client, name)) for name in by_hand]
    built = (ultragray_client.FrameStream, ultragray_client.AsyncFrameStream)  # by `stream`
    found = {
        call_of(value) if isinstance(value, type) and not issubclass(value, (Enum, *built)) else name
        for name, value in named
    }
    assert set(table("Python client")) == found


def test_client_methods() -> None:
    groups = {
        "": ultragray_client.Client,
        "scenes.": client_scenes.Scenes,
        "datasets.": client_datasets.Datasets,
        "jobs.": client_jobs.Jobs,
        "workers.": client_workers.Workers,
        "stream.": ultragray_client.FrameStream,
    }
    found = [
        prefix + call_of(method).replace("(self, ", "(").replace("(self)", "()")
        for prefix, cls in groups.items()
        for name, method in vars(cls).items()
        if not name.startswith("_")
    ]
    assert list(table("Client methods")) == found
