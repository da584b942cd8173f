"""The CRC-64 of ECMA-182 that every OpenIGTLink message carries: polynomial 0x42F0E1EBA9EA3693, no reflection, no
initial or final inversion."""

from __future__ import annotations

from functools import cache

import numpy as np

_POLYNOMIAL = 0x42F0E1EBA9EA3693  # of degree 64, whose own coefficient is not written
_LOW_64 = (1 << 64) - 1
_WORD_BYTES = 8
_FOLD_ABOVE_WORDS = 192  # shorter messages are done byte by byte
_TRIES = 16  # one part in so many of the exponents that would do is searched for the lightest


def crc64(data: bytes | bytearray | memoryview) -> int:
    """The checksum of `data`.

    The data is a polynomial over GF(2). P(x) divides P(x⁶⁴) = P(x)⁶⁴, so words of 64 bits may be reduced modulo P(y),
    y = x⁶⁴, by XORs of whole words: yᵏ mod P(y) has at most 64 terms, so the upper words, shifted and added that
    often, replace themselves, and half of the data is gone. What remains is divided byte by byte.
    """
    if len(data) > _WORD_BYTES * _FOLD_ABOVE_WORDS:
        data = _folded(data)
    table = _table()
    remainder = 0
    for byte in data:
        remainder = (remainder << 8 & _LOW_64) ^ table[remainder >> 56 ^ byte]
    return remainder


def _folded(data: bytes | bytearray | memoryview) -> bytes:
    """A short message with the same checksum."""
    count = -(-len(data) // _WORD_BYTES)
    words = np.zeros(count, np.uint64)
    words.view(np.uint8)[count * _WORD_BYTES - len(data) :] = np.frombuffer(data, np.uint8)  # leading zeros are free
    while len(words) > _FOLD_ABOVE_WORDS:
        exponent, terms = _fold(len(words))
        upper, lower = words[:-exponent], words[-exponent:]
        for term in terms:
            end = exponent - term
            part = lower[end - len(upper) : end]
            np.bitwise_xor(part, upper, out=part)
        words = lower
    return words.tobytes()


@cache
def _table() -> list[int]:
    """The remainders of one byte followed by eight zero bytes."""
    remainders = []
    for byte in range(256):
        remainder = byte << 56
        for _ in range(8):
            remainder = _times_x(remainder)
        remainders.append(remainder)
    return remainders


def _fold(count: int) -> tuple[int, tuple[int, ...]]:
    """An exponent k by which `count` words may be folded, and the terms of yᵏ mod P(y); few terms, where possible."""
    least = (count + 64) // 2  # the shifted upper words must fit into the lower ones
    step = max(1, (1 << least.bit_length()) // 16)
    least = min(-(-least // step) * step, count - 1)
    return _lightest(least, min(least + least // _TRIES, count - 1))


@cache
def _lightest(first: int, last: int) -> tuple[int, tuple[int, ...]]:
    remainder = _power(first)
    best, lightest = first, remainder
    for exponent in range(first + 1, last + 1):
        remainder = _times_x(remainder)
        if remainder.bit_count() < lightest.bit_count():
            best, lightest = exponent, remainder
    return best, tuple(term for term in range(64) if lightest >> term & 1)


def _power(exponent: int) -> int:
    """xᵏ mod P(x)."""
    remainder = 1
    for bit in bin(exponent)[2:]:
        squared = 0
        for position in range(63, -1, -1):
            squared = _times_x(squared)
            if remainder >> position & 1:
                squared ^= remainder
        remainder = _times_x(squared) if bit == "1" else squared
    return remainder


def _times_x(remainder: int) -> int:
    return (remainder << 1 & _LOW_64) ^ (_POLYNOMIAL if remainder >> 63 else 0)
