"""The names of the methods, in the order of tables. Free of torch: command lines, services and clients' contracts know
them, too.
"""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.errors import InvalidArgument

ALL = "all"
NAMES = (
    "scene",
    *("median", "mean", "maximum"),
    *("median-0.25mm", "mean-0.25mm", "maximum-0.25mm"),
    *("linear", "nearest"),
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
