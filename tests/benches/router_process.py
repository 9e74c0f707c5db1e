"""Starts the router of one computer's bus as a process of its own."""

from __future__ import annotations

import subprocess
import sys


def start_router(endpoint: str) -> subprocess.Popen[str]:
    """Start a router that ends with this process, and wait until it is ready."""
    command = [sys.executable, "-m", "swarmctl.bus.network.router", endpoint, "--die-with-parent"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("router ready")
    return process
