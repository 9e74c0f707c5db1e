"""A display in a thread of its own, so that a terminal that takes nothing holds up no flight.

A terminal is not read while its user has stopped it (Ctrl-S, a text that is being marked) or the link to it is down.
Who supervises vehicles would wait in the middle of a line for as long as that, deaf to everything, also to Ctrl-C.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from swarmctl.ops.supervision.status_table import AgentView, Display

_MOST_WAITING = 1000  # lines; older ones are in the event log
_STUCK_S = 5.0  # without anything printed, after which the end does not wait for the rest


class BackgroundDisplay:
    """Has another display print what it is given, in the same order; of states only the newest.

    What is printed after the end, the verdict, is waited for: there is nothing left to supervise. It is lost where the
    terminal still takes nothing; the run folder holds it.

    Args:
        display: used in the thread alone, until it has ended.
        failed: is told once, in words, why something could not be printed; the rest is printed all the same.
    """

    def __init__(self, display: Display, failed: Callable[[str], None]) -> None:
        self._display, self._failed, self._has_failed = display, failed, False
        self._waiting: deque[Callable[[], None]] = deque(maxlen=_MOST_WAITING)
        self._shown: Callable[[], None] | None = None  # the newest state, while it waits
        self._is_closed, self._printed = False, 0
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._print, name="display", daemon=True)
        self._thread.start()

    def print_line(self, text: str) -> None:
        self._put(lambda: self._display.print_line(text))

    def show(self, agents: Sequence[AgentView]) -> None:
        views = [replace(view) for view in agents]

        def show() -> None:
            self._display.show(views)

        with self._changed:
            if self._waiting and self._waiting[-1] is self._shown:
                self._waiting.pop()
            self._shown = show
        self._put(show)

    def close(self) -> None:
        """Print what is left, unless the terminal takes nothing, and leave the last state on the screen."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        printed = -1
        while self._thread.is_alive() and printed != self._printed:
            printed = self._printed
            self._thread.join(_STUCK_S)

    def _put(self, prints: Callable[[], None]) -> None:
        if self._is_closed and not self._thread.is_alive():
            prints()
            return
        with self._changed:
            self._waiting.append(prints)
            self._changed.notify()

    def _print(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if not self._waiting:
                    break
                prints = self._waiting.popleft()
            self._attempt(prints)
            self._printed += 1
        self._attempt(self._display.close)

    def _attempt(self, prints: Callable[[], None]) -> None:
        """Print something; what can't be shown, as a terminal or others' numbers are, must not end the display."""
        try:
            prints()
        except Exception as error:
            if not self._has_failed:
                self._has_failed = True
                self._failed(f"{type(error).__name__}: {error}")
