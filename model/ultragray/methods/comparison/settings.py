"""ComparisonSettings: what a comparison compares, and what each method may take. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass

from ultragray.contract import Contract, described
from ultragray.methods.budget import BudgetKind
from ultragray.methods.names import ALL, NAMES, chosen_names

EVERY_METHOD = (ALL,)


@dataclass(frozen=True)
class ComparisonSettings(Contract):
    """Settings of a comparison. Raises InvalidArgument, naming the field, for a method or a value that cannot be."""

    __topic__ = "Comparison"
    methods: tuple[str, ...] = described(
        f"Methods to compare, some of {', '.join(NAMES)}; all: each of them.", EVERY_METHOD
    )
    budget: str = described(
        "equal: every method learns as long as the scene does with the preset fast on this machine; author: the steps "
        "of each author's recipe, however long they take.",
        BudgetKind.EQUAL.value,
        choices=tuple(kind.value for kind in BudgetKind),
    )
    times: float = described(
        "Factor on the equal time, for the methods other than the scene.", 1.0, low=0.001, high=1_000.0
    )
    seed: int = described("Of every random choice.", 0, low=0, high=2**63 - 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen_names(self.methods)
