"""The errors of the project: one stable reason each, and the way through a pipe."""

import pickle
import re

import pytest

from ultragray import errors
from ultragray.errors import InvalidPose, error_classes
from ultragray_service import errors as service_errors
from ultragray_workers import errors as workers_errors

MODULES = {errors.__name__, workers_errors.__name__, service_errors.__name__}
CLASSES = [cls for cls in error_classes() if cls.__module__ in MODULES]


def test_every_error_has_a_reason_of_its_own():
    reasons = [cls.reason for cls in CLASSES]
    assert len(set(reasons)) == len(reasons)
    assert all(re.fullmatch("[A-Z][A-Z_]*", reason) for reason in reasons)
    assert all(cls.title for cls in CLASSES)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_errors_cross_a_pipe_unchanged(cls):
    copy = pickle.loads(pickle.dumps(cls("what went wrong", field="poses[3]")))
    assert type(copy) is cls
    assert (copy.detail, copy.field, str(copy)) == ("what went wrong", "poses[3]", "what went wrong")


def test_the_drawn_tree_is_the_tree():
    own = [cls for cls in CLASSES if cls.__module__ == errors.__name__]
    assert errors.__doc__ is not None
    drawn = re.findall(r"^((?:│   )?[├└]── |)([A-Z]\w+)$", errors.__doc__, re.MULTILINE)
    assert [name for _, name in drawn] == [cls.__name__ for cls in own]
    inside = [name for lines, name in drawn if lines.startswith("│")]
    assert inside == [cls.__name__ for cls in own if cls.__base__ is errors.InvalidArgument]


def test_invalid_arguments_are_value_errors():
    assert issubclass(InvalidPose, ValueError)
