from __future__ import annotations

import base64

import pytest
from ultragray_workers.jobs.queue.listing import read_token, write_token

from ultragray.errors import InvalidArgument


def test_there_and_back() -> None:
    assert read_token(write_token(123, ["a", "b"])) == (123, ["a", "b"])


@pytest.mark.parametrize(
    "text", ["", "nothing", "[" * 20_000, "[1]", '["1", []]', "[1, [{}]]", "[-1, []]", "[1e9, []]"]
)
def test_what_no_page_gave_is_refused(text: str) -> None:
    with pytest.raises(InvalidArgument, match="page_token") as caught:
        read_token(base64.urlsafe_b64encode(text.encode()).decode())
    assert len(caught.value.detail) < 200
