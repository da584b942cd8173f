"""Where measured figures come from."""

from __future__ import annotations

import subprocess
from pathlib import Path

import torch

from ultragray.machine import processor_name

FOLDER = Path(__file__).resolve().parent
CHANGED = "-dirty"


def origin() -> dict[str, str]:
    """The commit of the model and the machine."""
    return {"commit": model_commit(), "machine": f"{processor_name()}, {torch.get_num_threads()} threads"}


def model_commit() -> str:
    """The last commit that changed the model, and whether it is changed since."""
    commit, changed = (
        subprocess.run(["git", "-C", str(FOLDER), *words, "--", "../model"], check=True, capture_output=True, text=True)
        for words in (("log", "-1", "--format=%h"), ("status", "--porcelain"))
    )
    return commit.stdout.strip() + (CHANGED if changed.stdout else "")


def is_clean(commit: str) -> bool:
    """Whether `model_commit` gave this of a model as it was committed."""
    return not commit.endswith(CHANGED)
