"""A worker process in parts; all of it is tested through the pool."""

from typing import get_args

from ultragray.geometry.probe import Lines
from ultragray_workers.pool.worker import example_probes


def test_every_bundle_of_scan_lines_is_warmed_up():
    assert {type(probe.lines) for probe in example_probes()} == set(get_args(Lines))
