"""Starts worker processes within milliseconds: forks of template processes that have torch imported.

There are two templates, so that a worker can be replaced at once even when a template was killed a moment
before: the survivor forks both the worker and the next template.
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ultragray_workers.pool.channel import Channel
from ultragray_workers.pool.messages import ForkTemplate, ForkWorker, Hello
from ultragray_workers.pool.peer import Peer

_TEMPLATES = 2


def start_template(descriptor: int) -> subprocess.Popen[bytes]:
    """Starts a template process that serves the channel of a descriptor, which it inherits."""
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; "
        f"from ultragray_workers.pool.process.template import main; main({descriptor})"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.DEVNULL,
        pass_fds=[descriptor],
        # numpy's OpenBLAS starts its threads on import, and a process with threads must not be forked
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


class Launcher:
    """Owns the template processes. Its methods belong to the event loop's thread."""

    def __init__(self) -> None:
        self._templates: list[_Template] = []  # oldest first
        self._reaping: set[asyncio.Future[int]] = set()
        self._closing = False

    def launch(
        self,
        request: ForkWorker | ForkTemplate,
        on_message: Callable[[Any], None],
        on_gone: Callable[[], None],
        descriptors: Sequence[int] = (),
    ) -> Peer:
        """Has a template fork a process, which gets the descriptors; the first message of the new peer is its Hello.

        Returns at once. Where no template is ready yet the request waits for one; where that dies before it
        forked, the new peer is gone.
        """
        template = next((t for t in self._templates if t.ready), None)
        if template is None:
            template = self._templates[0] if self._templates else self._spawn_template()
        near, far = Channel.pair()
        template.peer.send(request, [far.fileno(), *descriptors])
        far.close()
        return Peer(near, on_message, on_gone)

    def abandon_starting(self) -> None:
        """Kills templates that are still importing, and with them what waits to be forked."""
        self._closing = True
        for template in self._templates:
            if not template.ready and template.process is not None:
                template.process.kill()

    async def close(self) -> None:
        """Returns when all templates are gone. Stop the workers first: they are the templates' children."""
        self._closing = True
        for template in reversed(self._templates.copy()):  # children before parents
            await template.peer.stop()
        await asyncio.gather(*self._reaping)

    def _spawn_template(self) -> _Template:
        near, far = Channel.pair()
        process = start_template(far.fileno())
        far.close()
        template = _Template(process)
        template.peer = Peer(near, partial(self._on_hello, template), partial(self._on_gone, template))
        self._templates.append(template)
        return template

    def _fork_template(self) -> None:
        template = _Template(None)
        template.peer = self.launch(ForkTemplate(), partial(self._on_hello, template), partial(self._on_gone, template))
        self._templates.append(template)

    def _on_hello(self, template: _Template, hello: Hello) -> None:
        template.ready = True
        template.peer.pid = hello.pid
        self._top_up()

    def _on_gone(self, template: _Template) -> None:
        self._templates.remove(template)
        if template.process is not None:
            reaping = asyncio.get_running_loop().run_in_executor(None, template.process.wait)
            self._reaping.add(reaping)
            reaping.add_done_callback(self._reaping.discard)
        if template.ready:  # one that cannot even start is tried again only when a worker is wanted
            self._top_up()

    def _top_up(self) -> None:
        if self._closing:
            return
        if not self._templates:
            self._spawn_template()
        elif len(self._templates) < _TEMPLATES and self._templates[0].ready:
            self._fork_template()


class _Template:
    peer: Peer

    def __init__(self, process: subprocess.Popen[bytes] | None) -> None:
        self.process = process  # None: forked from another template, which reaps it
        self.ready = False
