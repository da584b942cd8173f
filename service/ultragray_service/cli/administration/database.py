"""The database of an installation, as the commands find it that look after one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

from ultragray.errors import InvalidArgument
from ultragray_service.cli.options import FieldsOf
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings

if TYPE_CHECKING:
    from ultragray_workers.jobs.queue.database import JobDatabase

Where = Annotated[
    dict[str, Any],
    FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX),
]


@contextmanager
def opened_database(where: dict[str, Any]) -> Iterator[JobDatabase]:
    """The database that the options name. Raises InvalidArgument where there is no such installation, StartupFailed."""
    from ultragray_workers.jobs.places import shared_storage
    from ultragray_workers.jobs.queue.database import JobDatabase

    settings = load_settings(**where)
    if settings.database_url is None and not settings.is_there:
        raise InvalidArgument(
            f"data_folder must be an existing folder, got {str(settings.data_folder)!r}: name that of the service with "
            "--data-folder",
            field="data_folder",
        )
    database = JobDatabase(settings.working_folder, settings.database_url, shared_storage(settings.artifacts))
    try:
        yield database
    finally:
        database.close()
