"""The live table as a terminal of 80x24 shows it: a capture of its screen, not of what was written to it."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time

import pyte
import pytest

from swarmctl.ops.supervision.status_table import COLUMNS
from tests.unit.ops.supervision.test_status_table import fleet

pytestmark = [pytest.mark.process, pytest.mark.timeout(60)]

WIDTH, HEIGHT, LINES = 80, 24, 4
SHOW = """
import sys, time
from swarmctl.ops.supervision.status_table import open_display
from tests.unit.ops.supervision.test_status_table import fleet
views, display = fleet(int(sys.argv[1])), open_display(run="swarm")
for k in range(int(sys.argv[2])):
    display.print_line(f"line {k} above the table")
    display.show(views)
    time.sleep(0.35)
while True:
    display.show(views)
    time.sleep(0.1)
"""


class Terminal:
    """A pseudo-terminal with a program on it, and the screen that a person would see."""

    def __init__(self, agents: int, width: int = WIDTH) -> None:
        self._screen = pyte.Screen(width, HEIGHT)
        self._stream = pyte.ByteStream(self._screen)
        self._fd, child_fd = pty.openpty()
        self._resize(child_fd, width)
        environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        self._process = subprocess.Popen(
            [sys.executable, "-c", SHOW, str(agents), str(LINES)],
            stdin=child_fd,
            stdout=child_fd,
            env=environment | {"TERM": "xterm-256color"},
            start_new_session=True,
        )
        os.close(child_fd)
        os.set_blocking(self._fd, False)

    def _resize(self, fd: int, width: int) -> None:
        fcntl.ioctl(fd, termios.TIOCSWINSZ, struct.pack("HHHH", HEIGHT, width, 0, 0))

    def resize(self, width: int) -> None:
        """Make the window narrower or wider, as its user does."""
        self._resize(self._fd, width)
        self._screen.resize(HEIGHT, width)
        self._process.send_signal(signal.SIGWINCH)

    def lines_after(self, seconds: float) -> list[str]:
        """Return what the screen shows after a while."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            try:
                self._stream.feed(os.read(self._fd, 65_536))
            except BlockingIOError:
                time.sleep(0.02)
        return [line.rstrip() for line in self._screen.display]

    def wait_until_shown(self) -> None:
        until_s = time.monotonic() + 30.0
        while not any(f"line {LINES - 1} above" in line for line in self.lines_after(0.1)):
            assert time.monotonic() < until_s and self._process.poll() is None

    def close(self) -> None:
        self._process.kill()
        self._process.wait(10)
        os.close(self._fd)


def whole(lines: list[str], agents: int, width: int) -> None:
    """Assert that every row of the table is on the screen, with every word whole, and that there is one table only."""
    columns = [column for column in COLUMNS if width >= 117 or not column.only_wide]
    titles = [column.title for column in columns]
    heads = [row for row, line in enumerate(lines) if line.split() == titles]
    assert len(heads) == 1, "drawn in place, never once more below what was torn"
    for i, view in enumerate(fleet(agents)):
        cells = [word for column in columns for word in column.cell_of(view).split()]
        assert lines[heads[0] + 2 + i].split() == cells
        assert lines[heads[0] + 2 + i].split()[0] == str(i)
    assert "…" not in "".join(lines)


@pytest.mark.parametrize("agents", [3, 12])
def test_a_screen_of_80x24_shows_every_agent_and_no_word_is_cut(agents: int) -> None:
    terminal = Terminal(agents)
    try:
        terminal.wait_until_shown()
        lines = terminal.lines_after(0.8)
        whole(lines, agents, WIDTH)
        if agents == 3:
            assert lines[:LINES] == [f"line {k} above the table" for k in range(LINES)]
    finally:
        terminal.close()


def test_a_window_that_becomes_wider_shows_more_and_tears_nothing() -> None:
    terminal = Terminal(3)
    try:
        terminal.wait_until_shown()
        terminal.resize(130)
        whole(terminal.lines_after(1.0), 3, 130)
    finally:
        terminal.close()
