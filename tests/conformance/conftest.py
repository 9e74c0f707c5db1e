"""`pytest tests/conformance --autopilot-url udpin://127.0.0.1:14540`: the same rows against any autopilot."""

from __future__ import annotations

import os

import pytest

OPTIONS = {
    "--autopilot-url": ("SWARMCTL_AUTOPILOT_URL", "offboard link of an autopilot that is already running"),
    "--autopilot-gcs-url": ("SWARMCTL_AUTOPILOT_GCS_URL", "its ground station link"),
    "--autopilot-restart": ("SWARMCTL_AUTOPILOT_RESTART", "shell line that starts it; needed by rows with a reboot"),
}


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("conformance")
    for name, (variable, meaning) in OPTIONS.items():
        group.addoption(name, default=os.environ.get(variable, ""), help=f"{meaning} (or {variable})")
