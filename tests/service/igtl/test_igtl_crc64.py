from __future__ import annotations

import crcmod
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ultragray_service.igtl.messages import crc64

reference = crcmod.mkCrcFun(0x142F0E1EBA9EA3693, rev=False, initCrc=0, xorOut=0)


def test_the_check_value_of_the_catalogue() -> None:
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


@given(st.binary(max_size=200))
def test_short(data: bytes) -> None:
    assert crc64(data) == reference(data)


@pytest.mark.parametrize("size", [1535, 1536, 1537, 1543, 1544, 1545, 2047, 4096, 10_001, 262_144 + 72, 1_234_567])
def test_long(size: int) -> None:
    data = np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()
    assert crc64(data) == reference(data)


@given(st.integers(1500, 20_000), st.integers(0, 2**32))
def test_any_length(size: int, seed: int) -> None:
    data = np.random.default_rng(seed).integers(0, 256, size, np.uint8).tobytes()
    assert crc64(memoryview(data)) == reference(data)


def test_one_flipped_bit_is_seen() -> None:
    data = bytearray(300_000)
    seen = {crc64(data)}
    for place in (0, 1, 150_000, 299_999):
        data[place] ^= 1
        seen.add(crc64(data))
        data[place] ^= 1
    assert len(seen) == 5
