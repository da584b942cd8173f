"""The error tree: one stable reason each, the statuses that the front doors answer with, and the pipe."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator
from http import HTTPStatus

import grpc
import pytest

from ultragray import errors
from ultragray.errors import InvalidPose, UltragrayError


def tree(cls: type[UltragrayError] = UltragrayError) -> Iterator[type[UltragrayError]]:
    yield cls
    for child in cls.__subclasses__():
        yield from tree(child)


CLASSES = [cls for cls in tree() if cls.__module__ == errors.__name__]


def test_every_error_has_a_reason_of_its_own() -> None:
    reasons = [cls.reason for cls in CLASSES]
    assert len(set(reasons)) == len(reasons)
    assert all(re.fullmatch("[A-Z][A-Z_]*", reason) for reason in reasons)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_statuses_exist_and_mean_the_same_on_both_doors(cls: type[UltragrayError]) -> None:
    HTTPStatus(cls.http_status)
    code = grpc.StatusCode[cls.grpc_status]
    assert cls.title
    server_fault = {
        *(grpc.StatusCode.INTERNAL, grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED),
        *(grpc.StatusCode.UNIMPLEMENTED, grpc.StatusCode.RESOURCE_EXHAUSTED),
    }
    if cls.http_status >= 500:
        assert code in server_fault


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_errors_cross_a_pipe_unchanged(cls: type[UltragrayError]) -> None:
    copy = pickle.loads(pickle.dumps(cls("what went wrong", field="poses[3]")))
    assert type(copy) is cls
    assert (copy.detail, copy.field, str(copy)) == ("what went wrong", "poses[3]", "what went wrong")


@pytest.mark.parametrize(
    ("name", "reason", "http_status", "grpc_status"),
    [
        ("UltragrayError", "INTERNAL", 500, "INTERNAL"),
        ("InvalidPose", "INVALID_POSE", 422, "INVALID_ARGUMENT"),
        ("SceneNotFound", "SCENE_NOT_FOUND", 404, "NOT_FOUND"),
        ("QueueFull", "QUEUE_FULL", 429, "RESOURCE_EXHAUSTED"),
        ("DeadlineExceeded", "DEADLINE_EXCEEDED", 504, "DEADLINE_EXCEEDED"),
        ("NotReady", "NOT_READY", 503, "UNAVAILABLE"),
        ("Draining", "DRAINING", 503, "UNAVAILABLE"),
        ("NotAcceptable", "NOT_ACCEPTABLE", 406, "INVALID_ARGUMENT"),
        ("BodyTooLarge", "BODY_TOO_LARGE", 413, "INVALID_ARGUMENT"),
        ("CheckpointInvalid", "CHECKPOINT_INVALID", 422, "INVALID_ARGUMENT"),
        ("DatasetInvalid", "DATASET_INVALID", 422, "INVALID_ARGUMENT"),
        ("TrainingDiverged", "TRAINING_DIVERGED", 422, "FAILED_PRECONDITION"),
        ("TrainingStateInvalid", "TRAINING_STATE_INVALID", 422, "FAILED_PRECONDITION"),
        ("MemoryExceeded", "MEMORY_EXCEEDED", 507, "RESOURCE_EXHAUSTED"),
    ],
)
def test_what_clients_match_on_never_changes(name: str, reason: str, http_status: int, grpc_status: str) -> None:
    cls = getattr(errors, name)
    assert (cls.reason, cls.http_status, cls.grpc_status) == (reason, http_status, grpc_status)


def test_the_drawn_tree_is_the_tree() -> None:
    assert errors.__doc__ is not None
    drawn = re.findall(r"^(?:[│├└─ ]*)([A-Z]\w+Error|[A-Z][A-Za-z]+)(?: {2,}|$)", errors.__doc__, re.MULTILINE)
    assert set(drawn) == {cls.__name__ for cls in CLASSES}
    inside = re.findall(r"^│   [├└]── (\w+)", errors.__doc__, re.MULTILINE)
    assert set(inside) == {cls.__name__ for cls in CLASSES if issubclass(cls, errors.InvalidArgument)} - {
        "InvalidArgument"
    }


def test_invalid_arguments_are_value_errors() -> None:
    assert issubclass(InvalidPose, ValueError)
