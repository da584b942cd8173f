"""How often a policy finds the standard plane that it has learned to scan to: `make policy`.

The policy of `examples/scan_policy.py`, as the program learns it by itself; then so that frames of low confidence cost
it reward. Both are tried from the same starts in the demo scene.
"""

from __future__ import annotations

import runpy
import time
from functools import partial
from pathlib import Path
from typing import Any

from measuring import ROOT, Document, Lines, columns, measure_runs

STEPS, STARTS, SEED = 400, 200, 0
TRIED = 1_000_000  # seed of the starts
WAYS: dict[str, dict[str, Any]] = {
    "frames alone": {},
    "low confidence costs reward": {"min_confidence": 0.8, "low_confidence": "penalty"},
}


def measure(settings: dict[str, Any], _: Path) -> Document:
    example = runpy.run_path(str(ROOT / "examples" / "scan_policy.py"))
    began_s = time.process_time()
    policy = example["trained"](STEPS, SEED, **settings)
    learned_s = time.process_time() - began_s
    return {"starts": STARTS, "learned_s": learned_s, **example["tried"](policy, STARTS, TRIED, **settings)}


def reached_planes(runs: Document) -> Lines:
    """The table of the documents."""
    cells = {
        "Learned from": "{way}",
        "Starts": "{starts}",
        "Reached the plane": "{reached:.0%}",
        "Steps, median": "{steps:.0f}",
        "Mean confidence on the way": "{confidence:.2f}",
        "Processor time of learning": "{learned_s:.0f} s",
    }
    return columns(({"way": way, **run} for way, run in runs.items()), cells)


if __name__ == "__main__":
    measure_runs("policy", __doc__, {way: partial(measure, of) for way, of in WAYS.items()}, threads=1, at_once=2)
