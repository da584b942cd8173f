"""The names of the methods are those of the registry, and are known without torch."""

from __future__ import annotations

import subprocess
import sys

import pytest

from ultragray.errors import InvalidArgument
from ultragray.learn.evaluation.methods import NAMES, chosen_names
from ultragray_studies.methods.registry import METHODS, chosen_methods


def test_the_names_are_those_of_the_registry_in_its_order() -> None:
    assert tuple(METHODS) == NAMES


def test_words_choose_methods_in_the_order_of_the_table() -> None:
    assert chosen_names(("nearest", "median", "nearest")) == ("median", "nearest")
    assert chosen_names(("nearest", "all")) == NAMES
    assert list(chosen_methods(("nearest", "median"))) == ["median", "nearest"]


@pytest.mark.parametrize(("names", "got"), [(("median", "newest"), "got 'newest'"), ((), "got none")])
def test_an_unknown_name_is_refused_with_those_that_there_are(names: tuple[str, ...], got: str) -> None:
    with pytest.raises(InvalidArgument, match="median") as caught:
        chosen_names(names)
    assert got in caught.value.detail
    assert caught.value.field == "methods"


def test_the_settings_of_a_comparison_need_no_torch() -> None:
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; "
        "from ultragray.learn.evaluation.methods import ComparisonSettings; "
        "ComparisonSettings(methods=('median',)); print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout == b"False\n"
