"""What becomes of the viewer process is told once, and the addresses it shows the flight at."""

from __future__ import annotations

from typing import Any

from swarmctl.ops.processes import Child
from swarmctl.ops.supervision.viewer_watch import ViewerWatch

LIVE, PAGE = "rerun+http://127.0.0.1:9876/proxy", "http://127.0.0.1:9090?url=rerun"


class Viewer(Child):
    """A process of which everything is made up."""

    def __init__(self, *argv: str) -> None:
        self.argv, self.said, self.stopped = argv, list[str](), False
        self.code: int | None = None

    def poll(self) -> int | None:
        return self.code

    def is_stopped(self) -> bool:
        return self.stopped

    def how_it_ended(self) -> str:
        return "was killed"

    def line_with(self, text: str) -> str:
        return next((line for line in self.said if text in line), "")


class Scene:
    def __init__(self, *argv: str) -> None:
        self.viewer, self.told, self.published = Viewer(*argv), list[str](), list[str]()
        self.now_s = 100.0
        self.watch = ViewerWatch(self.viewer, self.tell, self.published.append, lambda: self.now_s)

    def tell(self, event: str, text: str, **fields: Any) -> None:
        self.told.append(text)

    def step(self, times: int = 3) -> list[str]:
        for _ in range(times):
            self.watch.step()
        told, self.told = self.told, []
        return told


def test_the_address_is_published_and_the_page_is_shown_where_it_was_asked_for() -> None:
    plain, window, web = Scene(), Scene("--view"), Scene("--web")
    for scene in (plain, window, web):
        assert scene.step() == []
        scene.viewer.said = [f"viewer {LIVE}", f"page {PAGE}"]
    assert plain.step() == [f"view {LIVE} (no window; open one with: swarmctl view)"]
    assert window.step() == [f"view {LIVE}"]
    assert web.step() == [f"view {LIVE}", f"open in a browser: {PAGE}"]
    assert plain.published == window.published == web.published == [LIVE]


def test_a_viewer_that_freezes_before_it_serves_a_page_or_ends_is_told_once() -> None:
    scene = Scene("--web")
    scene.viewer.said, scene.viewer.stopped = [f"viewer {LIVE}"], True
    assert scene.step() == [f"view {LIVE}", "viewer is frozen; the flight goes on"]
    scene.viewer.code = 137
    assert scene.step() == ["view and recording stopped: viewer was killed; the flight goes on"]


def test_the_address_of_a_viewer_that_has_ended_is_withdrawn() -> None:
    """Or `view` opens a page on which nothing ever moves."""
    scene = Scene()
    scene.viewer.said = [f"viewer {LIVE}"]
    scene.step()
    scene.viewer.code = 137
    scene.step()
    assert scene.published == [LIVE, ""]


def test_a_viewer_that_does_not_come_up_is_told_once_and_its_address_when_it_does() -> None:
    scene = Scene()
    scene.now_s += 19.0
    assert scene.step() == []
    scene.now_s += 2.0
    assert scene.step() == ["viewer is not up after 20 s; the flight goes on"]
    scene.viewer.said = [f"viewer {LIVE}"]
    scene.now_s += 100.0
    assert scene.step() == [f"view {LIVE} (no window; open one with: swarmctl view)"]


def test_a_viewer_that_is_up_in_time_is_not_late() -> None:
    scene = Scene()
    scene.viewer.said = [f"viewer {LIVE}"]
    scene.step()
    scene.now_s += 100.0
    assert scene.step() == []


def test_without_a_view_nothing_is_told() -> None:
    told: list[str] = []
    ViewerWatch(None, lambda event, text, **fields: told.append(text), told.append).step()
    assert told == []
