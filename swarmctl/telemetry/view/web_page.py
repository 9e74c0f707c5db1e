"""Serves the view as a page to browsers of this computer, and to nobody else: everything is bound to loopback.

`python -m swarmctl.telemetry.view.web_page ...` becomes rerun's server with those arguments, and dies with its parent.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import psutil

from swarmctl.errors import StartError
from swarmctl.process_lifetime import PARENT_ENV, die_with_parent, module_command
from swarmctl.telemetry.view.recordings import refuse_no_recording, viewer_binary
from swarmctl.telemetry.view.view_ports import HOST, held_view_port

_FIRST_PAGE_PORT, _FIRST_DATA_PORT = 9090, 9976  # the live view has 9876 and those above it
_BEGIN_S = 20.0  # longest time until it listens


class WebPage(NamedTuple):
    """A page that is served."""

    url: str
    process: subprocess.Popen[bytes]


@contextmanager
def web_page(target: str, log: Path | None = None) -> Iterator[WebPage]:
    """Serve the view of a live URL, or of a recording, until the block ends.

    Args:
        target: `rerun+http://...` or the path of an `.rrd`.
        log: file for the server's output; None to discard it.

    Raises:
        ConfigError: the file is no recording.
        StartError: there is no such recording, or no port is free, or the server does not start.
    """
    refuse_no_recording(target)
    with held_view_port(_FIRST_PAGE_PORT) as port, held_view_port(_FIRST_DATA_PORT) as data_port:
        if not port or not data_port:
            raise StartError(f"no free port from {_FIRST_PAGE_PORT} or {_FIRST_DATA_PORT} on for a page on {HOST}")
        with _serving(target, port, data_port, log) as page:
            yield page


@contextmanager
def _serving(target: str, port: int, data_port: int, log: Path | None) -> Iterator[WebPage]:
    """Serve a page on `port`, and a recording that it shows on `data_port`."""
    is_live = "://" in target
    source = target if is_live else f"rerun+http://{HOST}:{data_port}/proxy"
    command = module_command(__name__, "--serve-web", "--bind", HOST, "--web-viewer-port", f"{port}")
    command += (target,) if is_live else ("--port", f"{data_port}", target)
    environment = os.environ | {PARENT_ENV: f"{os.getpid()}"}
    with (log or Path(os.devnull)).open("ab") as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=environment, start_new_session=True
        )
    try:
        _wait_for_port(process, port)
        yield WebPage(f"http://{HOST}:{port}?url={quote(source, safe='')}", process)
    finally:
        process.terminate()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_for_port(process: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the process, not another one, listens on the port.

    Raises:
        StartError: it ends before, or takes too long.
    """
    until_s = time.monotonic() + _BEGIN_S
    while process.poll() is None and time.monotonic() < until_s:
        listening = psutil.Process(process.pid).net_connections("tcp4")
        if any(own.status == psutil.CONN_LISTEN and own.laddr.port == port for own in listening):
            return
        time.sleep(0.05)
    raise StartError(f"the page does not answer on {HOST}:{port}; rerun ended or took longer than {_BEGIN_S:g} s")


if __name__ == "__main__":
    die_with_parent(signal.SIGTERM)
    os.execv(viewer_binary(), ["rerun", *sys.argv[1:]])
