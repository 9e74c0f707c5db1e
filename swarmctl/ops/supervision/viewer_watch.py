"""Watches the viewer of a launch or station: where it shows the flight, and whether it is late, freezes or ends."""

from __future__ import annotations

import time
from collections.abc import Callable

from swarmctl.ops.processes import Child

_ADDRESS, _PAGE = "viewer rerun+", "page http://"  # how the lines begin in which it says where
_LATE_S = 20.0  # to come up, which takes 2 to 5 s: it yields to all processes of the flight


class ViewerWatch:
    """Tells everything once.

    Args:
        child: the process; None without a view.
        tell: receives event, text and fields.
        publish: receives the address of the live view, for the operator's `view`; "" once there is none any more.
        clock_s: monotonic time [s].
    """

    def __init__(
        self,
        child: Child | None,
        tell: Callable[..., None],
        publish: Callable[[str], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._child, self._tell, self._publish, self._clock_s = child, tell, publish, clock_s
        self._late_at_s = clock_s() + _LATE_S
        argv = () if child is None else child.argv
        self._hint = "" if {"--view", "--web"} & {*argv} else " (no window; open one with: swarmctl view)"
        self._awaited = [] if child is None else [_ADDRESS, *([_PAGE] if "--web" in child.argv else [])]
        self._is_frozen = self._is_late = False

    def step(self) -> None:
        """Tell what has happened since the last time."""
        child = self._child
        if child is None:
            return
        if child.poll() is not None:
            self._tell("viewer_ended", f"view and recording stopped: viewer {child.how_it_ended()}; the flight goes on")
            self._publish("")
            self._child = None
        elif self._awaited and (line := child.line_with(self._awaited[0])):
            self._take(line)
        elif not self._is_frozen and child.is_stopped():
            self._is_frozen = True
            self._tell("viewer_frozen", "viewer is frozen; the flight goes on")
        elif _ADDRESS in self._awaited and not (self._is_late or self._is_frozen) and self._clock_s() > self._late_at_s:
            self._is_late = True
            self._tell("viewer_late", f"viewer is not up after {_LATE_S:g} s; the flight goes on")

    def _take(self, line: str) -> None:
        """Tell the address that a line says."""
        url = line.split(" ", 1)[1]
        if self._awaited.pop(0) == _ADDRESS:
            self._tell("viewer_ready", f"view {url}{self._hint}", url=url)
            self._publish(url)
        else:
            self._tell("page_ready", f"open in a browser: {url}", url=url)
