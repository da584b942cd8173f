"""A proxy between a client and its service, which can break connections and lead elsewhere."""

import socket
import threading
from contextlib import suppress


class Proxy:
    """Passes bytes on to a service; `cut_after` breaks a connection once so many bytes came back."""

    def __init__(self, target):
        self.lead_to(target)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open = [self._listener]
        self._left = []
        self.cuts = 0
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def lead_to(self, target):
        """New connections lead to another service (HOST:PORT) from now on."""
        host, _, port = target.rpartition(":")
        self._target = (host, int(port))

    def cut_after(self, *counts):
        """Breaks the connection after so many bytes; the one that follows after as many as the next count says."""
        self._left = list(counts)

    def cut(self):
        """Breaks the connections that are open."""
        self._shut(self._open[1:])

    def close(self):
        self._shut(list(self._open))

    def _shut(self, ends):
        for one in ends:
            with suppress(OSError):  # it is shut already
                one.shutdown(socket.SHUT_RDWR)  # closing alone would not wake those that wait for it
            one.close()
            self._open.remove(one)

    def _accept(self):
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(self._target)
            except OSError:  # nobody is there
                near.close()
                continue
            self._open += [near, far]
            threading.Thread(target=self._pass, args=(near, far, False), daemon=True).start()
            threading.Thread(target=self._pass, args=(far, near, True), daemon=True).start()

    def _pass(self, source, sink, counted):
        try:
            while data := source.recv(16384):
                sink.sendall(data)
                if counted and self._left:
                    self._left[0] -= len(data)
                    if self._left[0] < 0:
                        self._left.pop(0)
                        self.cuts += 1
                        break
        except OSError:
            pass
        for one in (source, sink):
            try:
                one.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue
