"""Likelihoods and smoothing by second differences; time and memory grow linearly with the length of the path.

D takes the second differences of a path. ρ·1 + D·Dᵀ has five diagonals; in its factors L·diag(d)·Lᵀ the lower triangle
L has ones on the diagonal and two diagonals below it, and each row follows from the two rows before it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ultragray.probe import FloatArray


def likelihood_terms(bends: FloatArray, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
    """log det(ρ·1 + D·Dᵀ) [R] and bᵀ(ρ·1 + D·Dᵀ)⁻¹b [R, K] for each ratio ρ [R] and each column b of `bends` [B, K]."""
    log_determinants = np.zeros(len(ratios))
    squares = np.zeros((len(ratios), bends.shape[1]))
    one_back, two_back = np.zeros_like(squares), np.zeros_like(squares)  # rows of L⁻¹b
    for bend, (first, second, diagonal) in zip(bends, _factor_rows(len(bends), ratios), strict=True):
        solved = bend - first[:, None] * one_back - second[:, None] * two_back
        log_determinants += np.log(diagonal)
        squares += solved * solved / diagonal[:, None]
        one_back, two_back = solved, one_back
    return log_determinants, squares


def smoothed(values: FloatArray, ratio: float) -> FloatArray:  # [F] -> [F]
    """The path p of least ρ·|values − p|² + |D·p|², which is values − Dᵀ(ρ·1 + D·Dᵀ)⁻¹D·values. F is at least 4."""
    solution = np.diff(values, 2)
    first, second, diagonal = np.array([*_factor_rows(len(solution), np.array([ratio]))])[..., 0].T
    for row in range(len(solution)):  # negative places are multiplied by the zeros of the first two rows
        solution[row] -= first[row] * solution[row - 1] + second[row] * solution[row - 2]
    solution /= diagonal
    for row in reversed(range(len(solution))):
        solution[row - 1] -= first[row] * solution[row]
        solution[row - 2] -= second[row] * solution[row]
    return values - np.convolve(solution, [1.0, -2.0, 1.0])


def _factor_rows(count: int, ratios: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Row by row, for each ratio [R]: the entries of L one and two columns left of the diagonal, and that of d."""
    first = np.zeros_like(ratios)
    one_back = two_back = np.full_like(ratios, np.inf)  # d of the rows before
    for _ in range(count):
        rest = -4.0 - first
        first, second = rest / one_back, 1.0 / two_back
        diagonal = 6.0 + ratios - first * rest - second
        yield first, second, diagonal
        one_back, two_back = diagonal, one_back
