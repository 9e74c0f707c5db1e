"""Renders a run's `telemetry.rrd`, or a live URL, to a PNG without a display.

    python tools/screenshot.py runs/<run>/telemetry.rrd swarm.png --at 30

Needs a Vulkan driver (Debian: mesa-vulkan-drivers, libxkbcommon-x11-0); software rendering is enough.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from rerun.experimental import ViewerClient

from swarmctl.telemetry.view.layout import TIMELINE
from swarmctl.telemetry.view.recordings import viewer_binary

_LOAD_S = 30.0


def main() -> None:
    """Take one screenshot."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("target", help="a recording or rerun+http://... URL")
    parser.add_argument("png", type=Path)
    parser.add_argument("--at", type=float, default=20.0, help="flight time [s]")
    parser.add_argument("--port", type=int, default=9979)
    parser.add_argument("--settle", type=float, default=2.5, help="seconds to wait for the picture")
    options = parser.parse_args()
    os.environ["PATH"] = f"{viewer_binary().parent}{os.pathsep}{os.environ.get('PATH', '')}"
    with ViewerClient.spawn(headless=True, port=options.port, hide_welcome_screen=True) as viewer:
        viewer.open(options.target)
        until_s = time.monotonic() + _LOAD_S
        while viewer.get_state().loading and time.monotonic() < until_s:
            time.sleep(0.1)
        time.sleep(0.5)
        viewer.set_time(TIMELINE, duration=options.at, play_state="paused")
        time.sleep(options.settle)
        viewer.save_screenshot(str(options.png.resolve()))
        for view in viewer.get_state().views:
            for report in view.reports:
                print(f"{view}: {report}")
        for message in viewer.get_logs():
            if message.level in ("ERROR", "WARN"):
                print(f"{message.level}: {message}")


if __name__ == "__main__":
    main()
