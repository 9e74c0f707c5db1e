"""Renders a run's `telemetry.rrd`, or a live URL, to a PNG without a display.

    python tools/screenshot.py runs/<run>/telemetry.rrd swarm.png --at 30 --page Timing

Needs a Vulkan driver (Debian: mesa-vulkan-drivers, libxkbcommon-x11-0); software rendering is enough.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

from swarmctl.telemetry.scene.layout import TIMELINE
from swarmctl.telemetry.view.recordings import viewer_binary

_LOAD_S = 30.0
_TOP_PX = 36  # menu and warnings of the viewer itself, cut off pictures that are 1920 pixels wide
_BOTTOM_PX = 30
_ATTEMPTS = 5  # to take a screenshot


class Picture:
    """A viewer without a window that has loaded one recording."""

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer

    def open_page(self, name: str) -> None:
        """Open the page of plots that is called `Swarm`, `Timing`, or as the number of an agent."""
        blueprint = self._viewer.get_blueprint().blueprint
        containers = [entity["ContainerBlueprint"] for entity in blueprint.values() if "ContainerBlueprint" in entity]
        tabs = max((c for c in containers if c["container_kind"] == "Tabs"), key=lambda c: len(c["contents"]))
        names = {blueprint[f"/{key}"]["ContainerBlueprint"].get("display_name"): key for key in tabs["contents"]}
        tabs["active_tab"] = names[name]
        self._viewer.set_blueprint(blueprint, of="recording")

    def at(self, seconds: float, settle_s: float) -> Image.Image:
        """Return the whole window at a time of the flight, without the viewer's own bars."""
        self._viewer.set_time(TIMELINE, duration=seconds, play_state="paused")
        time.sleep(settle_s)
        window = self._shot()
        return window.crop((0, _TOP_PX, window.width, window.height - _BOTTOM_PX))

    def scene_at(self, seconds: float, settle_s: float, longest_px: int) -> Image.Image:
        """Return the scene alone."""
        self._viewer.set_time(TIMELINE, duration=seconds, play_state="paused")
        time.sleep(settle_s)
        scene = next(view for view in self._viewer.get_state().views if view.name == "Swarm, NED")
        return self._shot(scene.view_id, max_size=longest_px)

    def _shot(self, *view: str, **options: int) -> Image.Image:
        """Return a screenshot; a busy machine may take longer to paint it than the viewer waits."""
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(TimeoutError):
                return Image.open(io.BytesIO(self._viewer.take_screenshot(*view, **options))).convert("RGB")
        return Image.open(io.BytesIO(self._viewer.take_screenshot(*view, **options))).convert("RGB")

    def print_problems(self) -> None:
        """Print what the viewer could not draw, and its errors."""
        for view in self._viewer.get_state().views:
            for report in view.reports:
                print(f"{view}: {report}")
        for message in self._viewer.get_logs():
            if message.level == "ERROR":
                print(f"{message.level}: {message}")


@contextlib.contextmanager
def picture_of(target: str, port: int = 9979) -> Iterator[Picture]:
    """Yield a viewer of a recording or URL."""
    os.environ["PATH"] = f"{viewer_binary().parent}{os.pathsep}{os.environ.get('PATH', '')}"
    with ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True) as viewer:
        viewer.open(target)
        until_s = time.monotonic() + _LOAD_S
        time.sleep(1.0)  # it begins to load
        while viewer.get_state().loading and time.monotonic() < until_s:
            time.sleep(0.1)
        time.sleep(0.5)
        yield Picture(viewer)


def save_small(image: Image.Image, path: Path, width_px: int) -> None:
    """Write a picture for a page: scaled down, with a palette."""
    height_px = round(image.height * width_px / image.width)
    small = image.resize((width_px, height_px), Image.Resampling.LANCZOS)
    with_palette(small).save(path, optimize=True)


def with_palette(image: Image.Image) -> Image.Image:
    """Return a picture in 256 colours, thin lines in their own: a median cut would give most to the background."""
    return image.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def main() -> None:
    """Take one screenshot."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("target", help="a recording or rerun+http://... URL")
    parser.add_argument("png", type=Path)
    parser.add_argument("--at", type=float, default=20.0, help="flight time [s]")
    parser.add_argument("--page", help="page of plots to open: Swarm, Timing, or the number of an agent")
    parser.add_argument("--width", type=int, help="scale down to so many pixels, with a palette")
    parser.add_argument("--port", type=int, default=9979)
    parser.add_argument("--settle", type=float, default=2.5, help="seconds to wait for the picture")
    options = parser.parse_args()
    with picture_of(options.target, options.port) as picture:
        if options.page:
            picture.open_page(options.page)
        image = picture.at(options.at, options.settle)
        picture.print_problems()
    if options.width:
        save_small(image, options.png, options.width)
    else:
        image.save(options.png)


if __name__ == "__main__":
    main()
