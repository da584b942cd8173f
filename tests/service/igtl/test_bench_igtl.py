from __future__ import annotations

import numpy as np
import pytest

from ultragray_studies.bench.clients import PingPong
from ultragray_workers.errors import NotReady

from ..conftest import HEIGHT, WIDTH, RunningService
from .conftest import address_of


def test_ping_pong(igtl_service: RunningService) -> None:
    port = int(address_of(igtl_service).rpartition(":")[2])
    with PingPong(port, "demo") as client:
        first, second = client.render(np.eye(4)), client.render(np.eye(4))
        assert first.pixels.shape == (HEIGHT, WIDTH)
        assert np.array_equal(first.pixels, second.pixels)
        with pytest.raises(NotReady, match="rotation"):
            client.render(np.zeros((4, 4)))
