"""A network of its own for each test, so that two autopilots, or two tests, never meet on one port or one lock file.

Needs root, iproute2 and util-linux. Without them tests run in the machine's own network, one at a time, and only if its
ports are free.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import socket
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

TMP = Path("/tmp")
_NAMES = itertools.count()
_NAMESPACES = Path("/var/run/netns")
_OWN_TMP = f'mount --bind "$0" {TMP} && exec "$@"'


class Network:
    """The network in which a test's processes and sockets live.

    Attributes:
        prefix: of a command line that is to run in it.
    """

    def __init__(self, name: str = "") -> None:
        self._name = name
        self.prefix: tuple[str, ...] = ("ip", "netns", "exec", name) if name else ()

    @property
    def is_own(self) -> bool:
        """Return whether nobody else is in it."""
        return bool(self._name)

    @contextmanager
    def inside(self) -> Iterator[None]:
        """Sockets that this thread opens meanwhile belong to this network, and stay there."""
        if not self._name:
            yield
            return
        with Path("/proc/thread-self/ns/net").open() as home, (_NAMESPACES / self._name).open() as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(home.fileno())

    def taken(self, ports: Iterable[int]) -> list[int]:
        """Return the UDP ports that other processes hold."""
        return [port for port in ports if not self._free(port)]

    def _free(self, port: int) -> bool:
        with self.inside(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                return False
            return True


def with_tmp(folder: Path) -> tuple[str, ...]:
    """Return what goes before a command line for which that folder is `TMP`; everybody else keeps theirs."""
    return ("unshare", "--mount", "sh", "-c", _OWN_TMP, str(folder))


def _enter(namespace: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, 0):
        raise OSError(ctypes.get_errno(), "setns")


@contextmanager
def own_network() -> Iterator[Network]:
    """Return a new network where this user may make one; else the machine's."""
    name = f"swarmctl-{os.getpid()}-{next(_NAMES)}"
    if os.geteuid() != 0 or not _did("ip", "netns", "add", name):
        yield Network()
        return
    try:
        assert _did("ip", "netns", "exec", name, "ip", "link", "set", "lo", "up")
        yield Network(name)
    finally:
        _did("ip", "netns", "delete", name)


def _did(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False
