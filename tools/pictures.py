"""Makes the pictures in docs/: flies three and twelve agents, renders view and report, day and dark, without a display.

    python tools/pictures.py

Needs a Vulkan driver (Debian: mesa-vulkan-drivers, libxkbcommon-x11-0) and chromium; software rendering is enough. With
`--runs DIR` the runs are kept in `DIR/three` and `DIR/twelve`, and flown only where they are not there yet.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from screenshot import Picture, picture_of, save_small, with_palette

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
_WIDTH_PX = 1280
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_SETTLE_S = 2.5
_FRAME_S = 0.3  # of the animation: 67 of them, 20 s, stay below the size that a test allows
_RING_M = ((6.0, 0.0), (5.2, 3.0), (3.0, 5.2), (0.0, 6.0), (-3.0, 5.2), (-5.2, 3.0))  # and its other half
_GOALS_M = (
    *((-3.0, 2.0), (-3.0, 0.0), (-3.0, -2.0), (-1.0, -4.0), (1.0, -4.0), (3.0, -3.0)),
    *((4.5, -1.0), (4.5, 1.0), (3.0, 3.0), (1.0, 4.0), (-1.0, 4.0), (-4.5, 0.0)),
)
_TWELVE = f"""
name = "twelve"
swarm.agents = 12
start.positions_ned_m = {[[*place, 0.0] for place in (*_RING_M, *((-n, -e) for n, e in _RING_M))]}
mission.kind = "goto"
mission.duration_s = 14.0
mission.goto.goals_ned_m = {[[*place, -2.0] for place in _GOALS_M]}
mission.goto.goal_assignment = false

[[obstacles]]
center_ned_m = [0.0, 0.0, -1.0]
radius_m = 0.6
keep_out_m = 1.2
visibility_m = 8.0

[[obstacles]]
center_ned_m = [1.5, 2.0, 0.0]
column = true
radius_m = 0.3
keep_out_m = 0.8
visibility_m = 8.0
"""


def fly(directory: Path, *arguments: str) -> None:
    """Simulate into a run folder unless it is there."""
    if not (directory / "summary.json").exists():
        command = [sys.executable, "-m", "swarmctl", "simulate", *arguments, "--run-dir", str(directory)]
        subprocess.run(command, cwd=ROOT, check=True)


def show_view(picture: Picture, path: Path, at_s: float, page: str = "Swarm") -> None:
    """Render the window of the view at a time of the flight."""
    picture.open_page(page)
    save_small(picture.at(at_s, _SETTLE_S), path, _WIDTH_PX)


def show_page(page: Path, path: Path, size_px: tuple[int, int], *, dark: bool = False) -> None:
    """Render a page from its top, as wide and high as `size_px`."""
    browser = next(found for found in map(shutil.which, _BROWSERS) if found)
    options = ["--headless", "--disable-gpu", "--hide-scrollbars", f"--window-size={size_px[0]},{size_px[1]}"]
    options += ["--no-sandbox"] if os.geteuid() == 0 else []  # chromium's own does not work for root
    options += ["--blink-settings=preferredColorScheme=0"] if dark else []
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "page.png"
        command = [browser, *options, f"--user-data-dir={folder}/profile", f"--screenshot={shot}", page.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        image = Image.open(shot).convert("RGB")
        image.quantize(256, kmeans=5, dither=Image.Dither.NONE).save(path, optimize=True)  # keeps shades of the paper


def animate(picture: Picture, path: Path, times_s: Sequence[float], width_px: int) -> None:
    """Write an animation of the scene, as fast as the flight when `times_s` are `_FRAME_S` apart."""
    small = [with_palette(picture.scene_at(at_s, 0.4, width_px)) for at_s in times_s]
    small[0].save(path, save_all=True, append_images=small[1:], duration=round(1e3 * _FRAME_S), loop=0, optimize=True)


def make(runs: Path, docs: Path) -> None:
    """Make every picture."""
    three, twelve = runs / "three", runs / "twelve"
    fly(three, "--agents", "3", "--duration", "16")
    (runs / "twelve.toml").write_text(_TWELVE)
    fly(twelve, str(runs / "twelve.toml"))
    for run in (three, twelve):
        size_px = (_WIDTH_PX, 1100 if run == three else 1240)
        show_page(run / "report.html", docs / f"report_{run.name}.png", size_px)
        show_page(run / "report.html", docs / f"report_{run.name}_dark.png", size_px, dark=True)
    show_page(twelve / "report.html", docs / "report_phone.png", (500, 1500))
    with picture_of(str(three / "telemetry.rrd")) as picture:
        show_view(picture, docs / "view_three.png", 24.5)
        show_view(picture, docs / "view_agent.png", 24.5, "1")
        picture.print_problems()
    with picture_of(str(twelve / "telemetry.rrd")) as picture:
        show_view(picture, docs / "view_twelve.png", 20.5)
        animate(picture, docs / "flight.gif", [12.5 + _FRAME_S * k for k in range(67)], 540)
        picture.print_problems()


def main() -> None:
    """Make the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--runs", type=Path, help="folder of the runs; default: one that is removed afterwards")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of the pictures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        runs = options.runs or Path(folder)
        runs.mkdir(parents=True, exist_ok=True)
        make(runs.resolve(), options.out)


if __name__ == "__main__":
    main()
