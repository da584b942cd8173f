"""The copy of the registrations in memory: what was read before a change never takes the place of the change."""

from typing import Any, cast

import numpy as np
import pytest

from ultragray_service.core import registrations as store
from ultragray_service.core.registrations import NamedRegistration, Registrations

UNUSED = None


def kept(changed_at):
    facts = {"name": "robot", "scene": "demo", "changed_at": changed_at}
    return store.Kept(NamedRegistration(base_to_scene=cast(Any, np.eye(4).tolist()), **facts), None)


@pytest.mark.parametrize("changed", [kept("2026-01-02T00:00:00Z"), None], ids=["replaced", "deleted"])
def test_a_copy_is_read_again_where_the_service_changed_it_meanwhile(changed, monkeypatch):
    registrations = Registrations(UNUSED, UNUSED, UNUSED)
    before, after = {"robot": kept("2026-01-01T00:00:00Z")}, {} if changed is None else {"robot": changed}
    reads = []

    def read(connection):
        reads.append(after if reads else before)
        if len(reads) == 1:
            registrations._change_copy("robot", changed)  # after the rows were read, before they are copied
        return reads[-1]

    monkeypatch.setattr(store, "read_registrations", read)
    registrations.read(UNUSED)
    assert reads == [before, after]
    assert registrations._copy == after
