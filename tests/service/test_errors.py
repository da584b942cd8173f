"""The one table of the statuses that the front doors answer with."""

from http import HTTPStatus

import grpc
import pytest

from ultragray import errors
from ultragray.errors import error_classes
from ultragray_service import errors as service_errors
from ultragray_service.errors import STATUSES
from ultragray_workers import errors as workers_errors

MODULES = (errors, workers_errors, service_errors)
OF_THE_SERVER = {"INTERNAL", "UNAVAILABLE", "DEADLINE_EXCEEDED", "UNIMPLEMENTED", "RESOURCE_EXHAUSTED"}


def test_each_error_has_a_row_and_each_row_an_error():
    found = [cls.reason for cls in error_classes() if cls.__module__ in {module.__name__ for module in MODULES}]
    assert sorted(STATUSES) == sorted(found)


@pytest.mark.parametrize("reason", STATUSES)
def test_statuses_exist_and_mean_the_same_on_both_doors(reason):
    statuses = STATUSES[reason]
    assert grpc.StatusCode[statuses.grpc]
    if HTTPStatus(statuses.http) >= HTTPStatus.INTERNAL_SERVER_ERROR:
        assert statuses.grpc in OF_THE_SERVER
