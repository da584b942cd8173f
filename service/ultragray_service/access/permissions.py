"""Whether a principal may do an operation on something."""

from __future__ import annotations

from ultragray.errors import UltragrayError
from ultragray_service.access.owners import Owners, may_change, may_see
from ultragray_service.access.principal import Principal, Role
from ultragray_service.access.rules import Operation
from ultragray_service.errors import PermissionDenied
from ultragray_workers.errors import job_not_found
from ultragray_workers.jobs.queue.owners import Kind


def require_role(principal: Principal, operation: Operation) -> None:
    """Raises PermissionDenied, which names the role."""
    if operation.role is not None and not principal.role.includes(operation.role):
        raise PermissionDenied(
            f"{operation.name} needs the role {operation.role.value}, and {principal.name} has {principal.role.value}"
        )


async def require(principal: Principal, operation: Operation, name: str, owners: Owners) -> None:
    """Raises PermissionDenied; JobNotFound for a job that is private to somebody else.

    Scenes and datasets that are private to somebody else are found by nobody else, see `Owners.hides`.
    """
    require_role(principal, operation)
    if operation.about is None or principal.role is Role.ADMIN or not (operation.owned or operation.about is Kind.JOB):
        return
    ownership = await owners.of(operation.about, name)
    if operation.about is Kind.JOB and not may_see(principal, ownership):
        raise job_not_found(name)
    if operation.owned and not may_change(principal, ownership):
        await owners.require_existing(operation.about, name)
        raise _not_own(operation, name, ownership.owner)


def _not_own(operation: Operation, name: str, owner: str | None) -> UltragrayError:
    """The error at something that belongs to somebody else."""
    assert operation.about is not None
    whose = "nobody's" if owner is None else f"{owner}'s"
    return PermissionDenied(
        f"{operation.name} needs the role {Role.ADMIN.value}, or to be the owner's: the {operation.about.value} "
        f"{name[:128]!r} is {whose}",
        field=operation.about.value,
    )
