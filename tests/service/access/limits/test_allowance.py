from __future__ import annotations

import json
from pathlib import Path

import pytest

from ultragray.errors import InvalidArgument
from ultragray_service.access.principals import NAMES, Allowance, read_limits
from ultragray_service.settings import Settings, load_settings

from ...cli.command_line import run


def test_nothing_is_limited_unless_a_setting_says_so() -> None:
    assert Settings().allowance == Allowance() == Allowance(**dict.fromkeys(NAMES))


def test_settings_limit_every_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ULTRAGRAY_KEY_FRAMES_PER_S", "30")
    assert load_settings(key_stored_gb=0.5).allowance == Allowance(frames_per_s=30, stored_gb=0.5)


@pytest.mark.parametrize(
    "text", ["frames_per_s", "frames=3", "=3", "frames_per_s=0", "frames_per_s=often", "streams=-1"]
)
def test_a_limit_that_cannot_be_is_refused_with_what_was_given(text: str) -> None:
    with pytest.raises(InvalidArgument, match=r"frames_per_s|streams"):
        read_limits([text])


def test_a_key_keeps_limits_of_its_own(tmp_path: Path) -> None:
    where = ("--artifact-folder", tmp_path)
    limits = ("--limit", "frames_per_s=30", "--limit", "stored_gb=1.5", "--limit", "streams=none")
    made = run("keys", "create", "robot", "--role", "reader", *limits, *where)
    assert made.exit_code == 0, made.stderr
    assert run("keys", "create", "alice", "--role", "admin", *where).exit_code == 0
    robot, alice = json.loads(run("keys", "list", "--json", *where).stdout)
    assert robot["limits"] == {"frames_per_s": 30, "stored_gb": 1.5, "streams": None}
    assert alice["limits"] == {}
    assert "frames_per_s=30 stored_gb=1.5 streams=none" in run("keys", "list", *where).stdout.replace("\n", " ")
    refused = run("keys", "create", "carol", "--role", "reader", "--limit", "frames=3", *where)
    assert refused.exit_code == 2
    assert "got 'frames=3'" in refused.stderr
