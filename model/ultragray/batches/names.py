"""Names of many files in one, as WebDataset writes them: frames-{000000..000199}.tar."""

from __future__ import annotations

import re
from collections.abc import Iterator

_RANGE = re.compile(r"(?P<before>[^{}]*)\{(?P<first>\d{1,9})\.\.(?P<last>\d{1,9})\}(?P<after>[^{}]*)")


def name_range(before: str, last: int, after: str) -> str:
    """The names from number 0 to `last`; of one file, its name."""
    if last == 0:
        return f"{before}{0:06d}{after}"
    return f"{before}{{{0:06d}..{last:06d}}}{after}"


def names_in(name: str) -> Iterator[str]:
    """All names that a name stands for: those of its range, or itself."""
    found = _RANGE.fullmatch(name)
    if found is None:
        yield name
        return
    before, first, last, after = found.groups()
    for number in range(int(first), int(last) + 1):
        yield f"{before}{number:0{len(first)}d}{after}"


def stands_for(name: str, one: str) -> bool:
    """Whether `one` is among the names that `name` stands for; none of them is written out."""
    found = _RANGE.fullmatch(name)
    if found is None:
        return name == one
    before, first, last, after = found.groups()
    number = one.removeprefix(before).removesuffix(after)
    is_number = number.isascii() and number.isdecimal() and one == f"{before}{int(number):0{len(first)}d}{after}"
    return is_number and int(first) <= int(number) <= int(last)
