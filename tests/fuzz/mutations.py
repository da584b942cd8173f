"""Inputs that are nearly right: valid ones with a few changes, as strategies that shrink towards the valid."""

import copy
import json
import math
import re
import struct
from typing import Any

import numpy as np
from hypothesis import strategies as st

Strategy = st.SearchStrategy[Any]

NUMBERS = (
    0,
    1,
    -1,
    2,
    7,
    127,
    128,
    255,
    256,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53 + 1,
    2**63 - 1,
    2**64 - 1,
)
REALS = (0.0, -0.0, 1e-300, 5e-324, 0.5, 1e19, 1.8e308, float("inf"), float("-inf"), float("nan"))
TEXTS = (
    "",
    " ",
    "\0",
    "a\0b",
    "..",
    "../../etc/passwd",
    "/",
    "%2e%2e",
    "ä",
    "\ud83d\ude00",
    "x" * 129,
    "x" * 5000,
    "demo",
    "nan",
    "1e999",
)
JSON_VALUES = (
    *(None, True, False, [], {}, [[]], {"": 0}, [None], [0] * 17, {"w": 1}, [[1.0] * 4] * 4),
    *NUMBERS,
    *(-(2**63) - 1, 10**400),
    *REALS,
    *TEXTS,
)

_LARGEST_INSERT = 64
_REAL_LAYOUTS = "fd"
places = st.floats(0.0, 1.0, exclude_max=True)  # of the whole, so that a change keeps its place while the rest shrinks


def _edits(alphabet):
    """One change of bytes; the inserted ones are of `alphabet`, or any."""
    inserted = st.binary(max_size=_LARGEST_INSERT)
    if alphabet is not None:
        inserted = st.lists(st.sampled_from(list(alphabet)), max_size=_LARGEST_INSERT).map(bytes)
    formats = st.sampled_from(["<B", "<H", ">H", "<I", ">I", "<Q", ">Q", "<f", ">f", "<d", ">d"])
    return st.one_of(
        st.tuples(st.just(_flip), places, st.integers(0, 7)),
        st.tuples(st.just(_overwrite), places, inserted),
        st.tuples(st.just(_insert), places, inserted),
        st.tuples(st.just(_delete), places, st.integers(1, 200)),
        st.tuples(st.just(_repeat), places, st.tuples(st.integers(1, 64), st.integers(1, 40))),
        st.tuples(st.just(_number), places, st.tuples(formats, st.sampled_from([*NUMBERS, *REALS]))),
        st.tuples(st.just(_truncate), places, st.none()),
    )


def _flip(data, at, bit):
    if data:
        data[at] ^= 1 << bit


def _overwrite(data, at, new):
    data[at : at + len(new)] = new


def _insert(data, at, new):
    data[at:at] = new


def _delete(data, at, count):
    del data[at : at + count]


def _repeat(data, at, how):
    count, times = how
    data[at:at] = data[at : at + count] * times


def _number(data, at, what):
    layout, value = what
    size = struct.calcsize(layout)
    if layout[1] in _REAL_LAYOUTS:
        new = np.asarray(value, f"{layout[0]}f{size}").tobytes()
    else:
        whole = int(value) if math.isfinite(value) else -1
        new = (whole % 2 ** (8 * size)).to_bytes(size, "little" if layout[0] == "<" else "big")
    data[at : at + size] = new


def _truncate(data, at, _):
    del data[at:]


def mutated_bytes(valid, *, alphabet=None, most=5):
    """One of the valid inputs with up to `most` changes of bytes, numbers and lengths."""

    def apply(index, edits):
        changed = bytearray(valid[index])
        for edit, place, argument in edits:
            edit(changed, int(place * len(changed)), argument)
        return bytes(changed)

    return st.builds(apply, _indices(valid), st.lists(_edits(alphabet), max_size=most))


def _indices(valid):
    """Of the valid inputs: hypothesis writes out what it samples from."""
    return st.integers(0, len(valid) - 1)


def mutated_json(valid, *, most=4):
    """One of the valid documents, with up to `most` of its values replaced, doubled, renamed or taken away."""
    change = st.tuples(
        places, st.sampled_from(["set", "set", "set", "delete", "rename", "copy", "wrap"]), json_values()
    )

    def apply(index, changes):
        changed = {"": copy.deepcopy(valid[index])}
        for place, what, value in changes:
            spots = list(_spots(changed))
            _change(spots, spots[int(place * len(spots))], what, copy.deepcopy(value))
        return changed[""]

    return st.builds(apply, _indices(valid), st.lists(change, max_size=most))


def json_values():
    """Values that a document could not be expected to hold."""
    scalars = st.one_of(st.sampled_from(JSON_VALUES), st.floats(), st.integers(), st.text(max_size=20))
    nested = st.recursive(
        scalars,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
        max_leaves=8,
    )
    return st.one_of(st.sampled_from(JSON_VALUES), st.sampled_from(JSON_VALUES), nested)


def _spots(container):
    """Every place in a document: its container and its key there."""
    keys = range(len(container)) if isinstance(container, list) else list(container)
    for key in keys:
        yield container, key
        if isinstance(container[key], (dict, list)):
            yield from _spots(container[key])


def _change(spots, spot, what, value):
    container, key = spot
    match what:
        case "set":
            container[key] = value
        case "delete" if key != "":
            del container[key]
        case "rename" if isinstance(container, dict) and key != "":
            container[str(value)[:40]] = container.pop(key)
        case "delete" | "rename" | "copy":
            other, there = spots[len(repr(value)) % len(spots)]
            container[key] = copy.deepcopy(other[there])
        case "wrap":
            container[key] = [container[key]]
        case _:
            raise AssertionError(what)


def as_json(document):
    """JSON as Python writes it: NaN and Infinity too, and lone surrogates escaped."""
    return json.dumps(document).encode()


def mutated_lines(head, tail, *, most=4):
    """A header of text lines with up to `most` lines doubled, lost, moved, or with another number or word in them."""
    lines = head.split(b"\n")
    words = st.sampled_from([*(str(number).encode() for number in (*NUMBERS, *REALS, 10**30)), *_words(TEXTS)])
    change = st.tuples(
        st.integers(0, len(lines) - 1),
        st.sampled_from(["number", "number", "word", "word", "delete", "double", "move", "empty"]),
        places,
        words,
    )

    def apply(changes, kept):
        changed = list(lines)
        for index, what, place, word in changes:
            index %= len(changed)
            match what:
                case "number" | "word":
                    pattern = rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?" if what == "number" else rb"[\w.-]+"
                    found = list(re.finditer(pattern, changed[index]))
                    if found:
                        where = found[int(place * len(found))]
                        changed[index] = changed[index][: where.start()] + word + changed[index][where.end() :]
                case "delete":
                    del changed[index]
                    changed = changed or [b""]
                case "double":
                    changed.insert(index, changed[index])
                case "move":
                    changed.insert(int(place * len(changed)), changed.pop(index))
                case "empty":
                    changed[index] = word
                case _:
                    raise AssertionError(what)
        return b"\n".join(changed) + tail[: int(kept * len(tail))]

    whole = st.one_of(st.just(1.0), st.just(1.0), st.just(1.0), places)
    return st.builds(apply, st.lists(change, min_size=1, max_size=most), whole)


def _words(texts):
    return [text.encode("utf-8", "surrogatepass") for text in texts]


def chosen_parts(valid, mutated):
    """The files of a folder, of which one or two are mutated; `mutated` has a strategy for each of these names."""

    def strategy(names):
        changed = st.fixed_dictionaries({name: mutated[name] for name in names})
        return changed.map(lambda files: {**valid, **files})

    return st.lists(st.sampled_from(sorted(mutated)), min_size=1, max_size=2, unique=True).flatmap(strategy)
