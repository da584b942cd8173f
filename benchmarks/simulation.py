"""Simulates many replicas behind Envoy: `python benchmarks/simulation.py [--seeds 3] [--only STUDY ...]`.

1,000 replicas, 100,000 clients and 10,000 scenes; the policies of Envoy beside each other, then each setting by itself.
The figures go into build/bench/simulation.json; the tables of docs/scaling.md come from it. All that is random is
seeded: the same costs give the same figures.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from typing import Any

from registry import FIGURES, ROOT
from scaling import checks, picture
from scaling.cases import STUDIES
from scaling.costs import SceneCosts, Storage, measured_costs
from scaling.outcome import Outcome, mean_with_confidence, with_confidence
from scaling.study import Case, Policy, run
from scaling.workload import Workload
from ultragray.files import write_whole
from ultragray_studies.bench.report import measured

OUTPUT = FIGURES["simulation"].staged
PICTURE = ROOT / "docs" / "images" / "scaling.png"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("--seeds", type=int, choices=(3, 5), default=5, help="runs of each case")
    parser.add_argument("--only", nargs="+", choices=list(STUDIES), metavar="STUDY", help=", ".join(STUDIES))
    given = parser.parse_args()
    head, costs = measured(1), measured_costs()
    studies = {name: cases for name, cases in STUDIES.items() if given.only is None or name in given.only}
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as processes:
        answers = list(processes.map(checks.run, range(given.seeds)))
        cases = dict.fromkeys(case for cases in studies.values() for case in cases.values())
        found = _run(list(cases), costs, given.seeds, processes)
    document = {
        "measured": head,
        **({"quick": True} if given.only else {}),
        "seeds": given.seeds,
        "costs": [asdict(one) for one in costs],
        "storage": asdict(Storage()),
        "workload": asdict(Workload()),
        "policy": asdict(Policy()),
        "checks": {
            name: {"known": known, "simulated": mean_with_confidence([one[name] for one in answers])}
            for name, (known, _) in checks.CHECKS.items()
        },
        "studies": {study: {name: found[case] for name, case in cases.items()} for study, cases in studies.items()},
    }
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    write_whole(OUTPUT, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _run(
    cases: Sequence[Case], costs: Sequence[SceneCosts], seeds: int, processes: ProcessPoolExecutor
) -> dict[Case, Any]:
    """Every case with every seed."""
    runs = [(case, costs, seed) for case in cases for seed in range(seeds)]
    outcomes: list[Outcome] = []
    for outcome in processes.map(run, *zip(*runs, strict=True)):
        outcomes.append(outcome)
        sys.stderr.write(f"\r{len(outcomes)} of {len(runs)} runs")
    sys.stderr.write("\n")
    return {case: with_confidence(outcomes[seeds * i : seeds * (i + 1)]) for i, case in enumerate(cases)}


def draw(document: dict[str, Any]) -> None:
    """The picture of docs/scaling.md."""
    picture.draw(document, PICTURE)


if __name__ == "__main__":
    main()
