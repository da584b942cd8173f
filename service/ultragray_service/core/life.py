"""The phases of the service's life: what takes work asks here first whether it may."""

from __future__ import annotations

import asyncio
from enum import Enum

from ultragray_workers.errors import Draining, NotReady


class Phase(Enum):
    STARTING = "starting"
    SERVING = "serving"
    LEAVING = "leaving"  # serves, and is not ready: proxies send what is new elsewhere
    DRAINING = "draining"


class Life:
    def __init__(self) -> None:
        self.phase = Phase.STARTING
        self.draining = asyncio.Event()

    def begin_serving(self) -> None:
        if self.phase is Phase.STARTING:
            self.phase = Phase.SERVING

    def begin_leaving(self) -> None:
        """From now on the service is not ready, and answers as before."""
        self.phase = Phase.LEAVING

    def begin_draining(self) -> None:
        self.phase = Phase.DRAINING
        self.draining.set()

    def require_serving(self) -> None:
        if self.phase is Phase.STARTING:
            raise NotReady("the service is starting")
        if self.phase is Phase.DRAINING:
            raise Draining("the service is stopping")

    def require_staying(self) -> None:
        """Raises NotReady or Draining, the latter also while the service still serves and will stop."""
        self.require_serving()
        if self.phase is Phase.LEAVING:
            raise Draining("the service will stop; it still answers")
