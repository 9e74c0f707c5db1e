"""The tools that make the pictures of the docs, and the pictures.

A report is rendered where there is chromium. The view is rendered when it is asked for, `SWARMCTL_PICTURES=1`, because
a software Vulkan driver keeps every processor busy for seconds, beside flights in real time.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from swarmctl.telemetry.palette import agent_rgb
from swarmctl.telemetry.recording.run_files import load_run
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight
from swarmctl.telemetry.view.recordings import simulated_recording
from tests.benches.recorded_runs import write_configured_run

pytestmark = [pytest.mark.process, pytest.mark.timeout(300)]

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVERS = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json")]
ASKED = os.environ.get("SWARMCTL_PICTURES") == "1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of three agents."""
    directory = tmp_path_factory.mktemp("run")
    write_configured_run(directory, 3, 6.0)
    return directory


def test_pictures_are_small_and_every_one_is_shown() -> None:
    pages = "".join(page.read_text() for page in (ROOT / "README.md", *DOCS.glob("*.md")))
    shown = {Path(name).name for name in re.findall(r"\]\(([^)]+)\)", pages)}
    pictures = {path.name: path.stat().st_size for path in DOCS.iterdir() if path.suffix in (".png", ".gif")}
    assert len(pictures) > 5
    assert pictures.keys() - shown == set()
    assert {name for name, size in pictures.items() if size > (200_000 if name.endswith("png") else 1_500_000)} == set()
    with Image.open(DOCS / "flight.gif") as animation:
        assert getattr(animation, "n_frames", 1) > 20


@pytest.mark.skipif(BROWSER is None, reason="no chromium")
def test_a_report_is_rendered_by_day_and_in_the_dark(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / "tools")
    from pictures import show_page

    shades = []
    for dark in (False, True):
        path = tmp_path / f"{dark}.png"
        show_page(folder / "report.html", path, (800, 1000), dark=dark)  # with the view from above
        image = np.asarray(Image.open(path).convert("RGB"))
        shades.append(float(np.median(image)))
        assert near(image, agent_rgb(0)) and near(image, agent_rgb(1)), "agents have the same colours in both"
    assert shades[0] > 230
    assert shades[1] < 50


@pytest.mark.skipif(not ASKED or not DRIVERS, reason="not asked for, or no software Vulkan driver")
def test_the_view_is_rendered_without_a_display(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "tools")
    from screenshot import picture_of

    monkeypatch.setenv("VK_ICD_FILENAMES", str(DRIVERS[0]))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    recording = simulated_recording(tmp_path, load_run(folder), ViewedFlight(agents=(AgentBounds(),) * 3))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with picture_of(str(recording), port) as picture:
        until_s = time.monotonic() + 120.0
        for _ in itertools.takewhile(lambda _: time.monotonic() < until_s, itertools.count()):
            image = np.asarray(picture.at(4.0, 0.5))
            if all(near(image, agent_rgb(agent)) for agent in range(3)):
                return
    pytest.fail("the vehicles are not in the picture")


def near(image: Any, rgb: tuple[int, int, int]) -> bool:
    """Return whether a picture (H, W, 3) has at least 20 dots of about this colour."""
    return int((np.abs(image.astype(int) - rgb).max(axis=2) < 12).sum()) >= 20
