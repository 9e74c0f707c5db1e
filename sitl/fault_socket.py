"""Fault interface of a running simulator: JSON requests on a Unix datagram socket, each answered to its sender.

`{"fault": {"kind": "motor", "vehicle": 0, "value": 0.5, "for_s": 2}}` is answered by `{"ok": true, "since_boot_s": 12}`
or by `{"ok": false, "problems": ["value = 7: allowed for motor: 0 to 1 (...)"]}`.
"""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from typing import Any

from sitl.world import SitlWorld
from swarmctl.configuration.problems import validated
from swarmctl.errors import ConfigError
from swarmctl.process_lifetime import remove_socket
from swarmctl.simulator_config import FaultParams

_LARGEST = 8192
_REQUESTS_A_POLL = 20


class ControlSocket:
    """The control socket, bound to a path until `close`.

    Args:
        of_launch: the folder belongs to a launch; the last of router and simulator to end removes it.

    Raises:
        ConfigError: the path is taken or can't be made.
    """

    def __init__(self, path: Path, of_launch: bool = False) -> None:
        self._path = path
        self._of_launch = of_launch
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            before = os.umask(0o177)
            try:
                self._socket.bind(str(path))
            finally:
                os.umask(before)
        except OSError as error:
            self._socket.close()
            fix = "a path of at most 100 bytes, not taken, in a folder that exists"
            raise ConfigError("sitl", [f"control = {path}: {error}; allowed: {fix}"]) from error
        self._socket.setblocking(False)

    def poll(self, world: SitlWorld) -> None:
        """Answer the requests that have arrived, a bounded number at once."""
        for _ in range(_REQUESTS_A_POLL):
            try:
                request, sender = self._socket.recvfrom(_LARGEST)
            except OSError:
                return
            answer = json.dumps(handle(request, world)).encode()
            try:
                self._socket.sendto(answer, sender)
            except (OSError, TypeError):
                continue  # the sender has no address, or did not wait

    def close(self) -> None:
        self._socket.close()
        if self._of_launch:
            remove_socket(self._path)
        else:
            self._path.unlink(missing_ok=True)


def handle(request: bytes, world: SitlWorld) -> dict[str, Any]:
    """Execute a request, or return everything that is wrong with it."""
    try:
        asked = json.loads(request)
        wanted = asked["fault"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return _refused(['not a request: send {"fault": {"kind": ...}} as JSON'])
    try:
        fault = validated(FaultParams, wanted, "fault")
    except ConfigError as error:
        return _refused(list(error.problems))
    problems = list(fault.problems(world.params.vehicles, world.params.first_vehicle))
    if problems:
        return _refused(problems)
    world.faults.begin(fault, world.since_boot_us)
    return {"ok": True, "since_boot_s": world.since_boot_us * 1e-6}


def _refused(problems: list[str]) -> dict[str, Any]:
    return {"ok": False, "problems": problems}
