"""Scene files that are none: cut off, with bytes of the header changed, and with values of the description changed."""

import json

import numpy as np

_VALUES = (None, -1, 0, 1e308, -1e308, 0.5, 2**53, "", "x", [], [1], [[]], {}, {"kind": 3}, [1e308] * 9, True)


def hostile_files(data, count, seed):
    """So many variants of a scene file; some may still be scenes."""
    random = np.random.default_rng(seed)
    length = int.from_bytes(data[:8], "little")
    for size in (0, 3, 7, 8, 50, 8 + length - 1, 8 + length, 8 + length + 1, len(data) - 1):
        yield data[:size]
    for number in range(count):
        yield _described(data, length, random) if number % 2 else _scratched(data, length, random)


def _scratched(data, length, random):
    one = bytearray(data)
    for place in random.integers(0, 8 + length, size=random.integers(1, 8)):
        one[place] = random.integers(0, 256)
    return bytes(one)


def _described(data, length, random):
    header = json.loads(data[8 : 8 + length])
    info = json.loads(header["__metadata__"]["ultragray"])
    for _ in range(random.integers(1, 3)):
        where, key = info, random.choice(list(info))
        while isinstance(where[key], dict) and where[key] and random.random() < 0.8:
            where = where[key]
            key = random.choice(list(where))
        where[key] = _VALUES[random.integers(len(_VALUES))]
    header["__metadata__"]["ultragray"] = json.dumps(info)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + length :]
