"""A network in between: passes bytes on, at a given speed, until it is cut."""

import contextlib
import socket
import threading
import time

CHUNK_BYTES = 64 << 10


class TcpProxy:
    """Leads connections from a port of its own to `target`; `with` ends it.

    Attributes:
        passed: Bytes that went through, both ways.
        cuts: How often it was cut.
    """

    def __init__(self, target_port, *, bytes_per_s=None):
        self._target_port = target_port
        self._bytes_per_s = bytes_per_s
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self.passed = self.cuts = 0
        self._cut_after = None
        self._before_cut = lambda: None
        self._refuses = False
        self._open = set()
        self._mutex = threading.Lock()
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def cut(self):
        """Break all connections there are; new ones are taken."""
        with self._mutex:
            broken, self._open = self._open, set()
            self.cuts += 1
        for one in broken:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def refuse(self):
        """Break all connections there are, and new ones until `accept_again`."""
        self._refuses = True
        self.cut()

    def accept_again(self):
        """Take new connections again."""
        self._refuses = False

    def cut_after(self, count, before=lambda: None):
        """Break all connections once so many more bytes went through, having called `before`."""
        self._before_cut = before
        self._cut_after = self.passed + count

    def _accept(self):
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            if self._refuses:
                near.close()
                continue
            try:
                far = socket.create_connection(("127.0.0.1", self._target_port))
            except OSError:
                near.close()
                continue
            with self._mutex:
                self._open |= {near, far}
            thread = threading.Thread(target=self._join, args=(near, far), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _join(self, near, far):
        with near, far:
            if self._bytes_per_s:  # what a kernel holds is not part of the network's speed
                near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, CHUNK_BYTES)
                far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, CHUNK_BYTES)
            back = threading.Thread(target=self._pass, args=(far, near), daemon=True)
            back.start()
            self._pass(near, far)
            back.join()
            with self._mutex:
                self._open -= {near, far}

    def _pass(self, source, sink):
        try:
            while data := source.recv(CHUNK_BYTES):
                if self._bytes_per_s:
                    time.sleep(len(data) / self._bytes_per_s)  # what the network takes for it
                if (end := self._cut_after) is not None and self.passed + len(data) >= end:
                    self._cut_after = None
                    sink.sendall(data[: max(0, end - self.passed)])
                    self._before_cut()
                    self.cut()
                    break
                sink.sendall(data)
                self.passed += len(data)
        except OSError:
            pass
        for one in (source, sink):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()
        for thread in self._threads:
            thread.join(5)
