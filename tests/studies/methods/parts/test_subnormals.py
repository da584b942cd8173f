"""Subnormal numbers count as 0 in all threads of torch, and only where that is asked for."""

import pytest
import torch

from ultragray_studies.methods.learner import without_subnormals

LARGE = 4_000_000  # values: torch takes all its threads


def halves_that_stay():
    """How many of many smallest normal numbers are not 0 when they are halved."""
    smallest = torch.full((LARGE,), torch.finfo(torch.float32).tiny)
    return int((smallest * 0.5).view(torch.int32).count_nonzero())  # as bits: to compare is arithmetic too


def test_they_are_zero_in_every_thread_and_none_elsewhere():
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert halves_that_stay() == LARGE  # and torch has its helpers
        assert without_subnormals(halves_that_stay) == 0
        assert halves_that_stay() == LARGE
    finally:
        torch.set_num_threads(threads)


def test_an_error_comes_through():
    with pytest.raises(ZeroDivisionError):
        without_subnormals(lambda: 1 // 0)
