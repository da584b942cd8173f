"""Inputs that are nearly right: valid ones with a few changes, as strategies that shrink towards the valid."""

import copy
import json
import math
import re
import struct

import numpy as np
from hypothesis import strategies as st

_EDGES = tuple(2**bits + off for bits in (7, 8, 16, 31, 32, 53, 63, 64) for off in (-1, 0, 1))
NUMBERS = (0, 1, -1, 2, 7, *_EDGES)
REALS = (0.0, -0.0, 1e-300, 5e-324, 0.5, 1e19, 1.8e308, float("inf"), float("-inf"), float("nan"))
TEXTS = (
    *("", " ", "\0", "a\0b", "..", "../../etc/passwd", "/", "%2e%2e", "ä", "\ud83d\ude00", "demo", "nan", "1e999"),
    *("x" * 129, "x" * 5000),
)
JSON_VALUES = (
    *(None, True, False, [], {}, [[]], {"": 0}, [None], [0] * 17, {"w": 1}, [[1.0] * 4] * 4),
    *(*NUMBERS, -(2**63) - 1, 10**400, *REALS, *TEXTS),
)
_WORDS = [*(str(number).encode() for number in (*NUMBERS, *REALS, 10**30))]
_WORDS += [text.encode("utf-8", "surrogatepass") for text in TEXTS]
_LARGEST_INSERT = 64
places = st.floats(0.0, 1.0, exclude_max=True)  # of the whole, so that a change keeps its place while the rest shrinks


def _packed(layout, value):
    """A number as a file or a message holds it."""
    size = struct.calcsize(layout)
    if layout[1] in "fd":
        return np.asarray(value, f"{layout[0]}f{size}").tobytes()
    whole = int(value) if math.isfinite(value) else -1
    return (whole % 2 ** (8 * size)).to_bytes(size, "little" if layout[0] == "<" else "big")


def mutated_bytes(valid, *, alphabet=None, most=5):
    """One of the valid inputs with up to `most` changes of bytes, numbers and lengths; new bytes are of `alphabet`."""
    layouts = st.sampled_from(["<B", "<H", ">H", "<I", ">I", "<Q", ">Q", "<f", ">f", "<d", ">d"])
    if alphabet is None:
        new = st.binary(max_size=_LARGEST_INSERT) | st.builds(_packed, layouts, st.sampled_from([*NUMBERS, *REALS]))
    else:
        new = st.lists(st.sampled_from(list(alphabet)), max_size=_LARGEST_INSERT).map(bytes)
    kinds = st.sampled_from(["flip", "overwrite", "insert", "delete", "repeat", "truncate"])

    def apply(index, edits):
        data = bytearray(valid[index])
        for kind, place, inserted, count in edits:
            at = int(place * len(data))
            match kind:
                case "flip" if data:
                    data[at] ^= 1 << count % 8
                case "overwrite":
                    data[at : at + len(inserted)] = inserted
                case "insert":
                    data[at:at] = inserted
                case "delete":
                    del data[at : at + count]
                case "repeat":
                    data[at:at] = data[at : at + count % 64] * (1 + count // 5)
                case "truncate":
                    del data[at:]
        return bytes(data)

    edits = st.lists(st.tuples(kinds, places, new, st.integers(1, 200)), max_size=most)
    return st.builds(apply, _indices(valid), edits)


def _indices(valid):
    """Of the valid inputs: hypothesis writes out what it samples from."""
    return st.integers(0, len(valid) - 1)


def mutated_json(valid, *, most=4):
    """One of the valid documents, with up to `most` of its values replaced, doubled, renamed or taken away."""
    kinds = st.sampled_from(["set", "set", "set", "delete", "rename", "copy", "wrap"])

    def apply(index, changes):
        changed = {"": copy.deepcopy(valid[index])}
        for place, kind, value in changes:
            spots = list(_spots(changed))
            _change(spots, spots[int(place * len(spots))], kind, copy.deepcopy(value))
        return changed[""]

    return st.builds(apply, _indices(valid), st.lists(st.tuples(places, kinds, json_values()), max_size=most))


def json_values():
    """Values that a document could not be expected to hold."""
    known = st.sampled_from(JSON_VALUES)
    nested = st.recursive(
        known | st.floats() | st.integers() | st.text(max_size=20),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
        max_leaves=8,
    )
    return st.one_of(known, known, nested)


def _spots(container):
    """Every place in a document: its container and its key there."""
    for key in range(len(container)) if isinstance(container, list) else list(container):
        yield container, key
        if isinstance(container[key], (dict, list)):
            yield from _spots(container[key])


def _change(spots, spot, kind, value):
    container, key = spot
    match kind:
        case "set":
            container[key] = value
        case "delete" if key != "":
            del container[key]
        case "rename" if isinstance(container, dict) and key != "":
            container[str(value)[:40]] = container.pop(key)
        case "wrap":
            container[key] = [container[key]]
        case _:
            other, there = spots[len(repr(value)) % len(spots)]
            container[key] = copy.deepcopy(other[there])


def as_json(document):
    """JSON as Python writes it: NaN and Infinity too, and lone surrogates escaped."""
    return json.dumps(document).encode()


def mutated_lines(head, tail, *, most=4):
    """A header of text with up to `most` words, or what stands between them, replaced, doubled, lost or moved."""
    kinds = st.sampled_from(["set", "set", "set", "delete", "double", "move"])
    change = st.tuples(places, kinds, places, st.sampled_from(_WORDS))

    def apply(changes, kept):
        parts = re.split(rb"([\w.+-]+)", head)
        for place, kind, other, word in changes:
            at = int(place * len(parts))
            if kind == "set":
                parts[at] = word
            elif kind == "double":
                parts.insert(at, parts[at])
            else:
                part = parts.pop(at)
                if kind == "move":
                    parts.insert(int(other * len(parts)), part)
        return b"".join(parts) + tail[: int(kept * len(tail))]

    whole = st.one_of(st.just(1.0), st.just(1.0), st.just(1.0), places)
    return st.builds(apply, st.lists(change, min_size=1, max_size=most), whole)


def chosen_parts(valid, mutated):
    """The files of a folder, of which one or two are mutated; `mutated` has a strategy for each of these names."""

    def strategy(names):
        changed = st.fixed_dictionaries({name: mutated[name] for name in names})
        return changed.map(lambda files: {**valid, **files})

    return st.lists(st.sampled_from(sorted(mutated)), min_size=1, max_size=2, unique=True).flatmap(strategy)
