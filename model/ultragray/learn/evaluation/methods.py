"""The settings of a comparison of methods and the methods' names, which the wire contract of its job needs. Free of
torch; the methods themselves are in the distribution ultragray-studies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument


class BudgetKind(str, Enum):
    """The closed set of budgets."""

    EQUAL = "equal"
    AUTHOR = "author"


ALL = "all"
NAMES = (
    "scene",
    *("median", "mean", "maximum"),
    *("median-0.25mm", "mean-0.25mm", "maximum-0.25mm"),
    *("linear", "nearest", "in-time"),
    *("ultranerf-released", "ultranerf-unit", "ultranerf-mean"),
    *("implicitvol", "implicitvol-refined"),
    "rapidvol",
    *("ultragauss", "ultragauss-shadow"),
)


def chosen_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names of methods that these words choose, in the order of NAMES; `all` is each of them.

    Raises InvalidArgument.
    """
    for name in names:
        if name not in NAMES and name != ALL:
            raise InvalidArgument(f"methods must be some of {ALL}, {', '.join(NAMES)}, got {name!r}", field="methods")
    if not names:
        raise InvalidArgument(f"methods must name at least one of {ALL}, {', '.join(NAMES)}, got none", field="methods")
    return tuple(name for name in NAMES if name in names or ALL in names)


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
