"""Verbs of the command line that fly, for scripts: each in a process of its own.

It has a session of its own. A Ctrl-C in the script therefore reaches it only through the script, which asks it
to land as the command line does; and a script that dies takes no vehicle with it.
"""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

from swarmctl.errors import (
    EXIT_INTERRUPTED,
    EXIT_MISSION,
    EXIT_OK,
    EXIT_START,
    EXIT_USAGE,
    ConfigError,
    MissionError,
    StartError,
    SwarmError,
)
from swarmctl.files import read_file
from swarmctl.process_lifetime import module_command

_FLEW = (EXIT_OK, EXIT_MISSION, EXIT_INTERRUPTED)  # exit codes of runs that were judged
_MAX_LOG_BYTES = 2**24
_LINES_TOLD = 5


class FlightProcess:
    """A process that flies into a run folder, and writes what it prints to a file there."""

    def __init__(self, name: str, folder: Path, *arguments: str) -> None:
        self._name = name
        self._log = folder / f"{name}.log"
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                module_command(*arguments),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def is_running(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def interrupt(self) -> None:
        """Ask it to land, as Ctrl-C does; the second time it ends at once."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait for its end; a Ctrl-C meanwhile lands, a second one ends everything at once.

        Raises:
            TimeoutError: it still runs after `timeout_s`.
            KeyboardInterrupt: after a Ctrl-C, once it has ended.
        """
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise TimeoutError(f"{self._name} still flies after {timeout_s:g} s") from error
        except KeyboardInterrupt:
            self.interrupt()
            try:
                self._process.wait()
            except KeyboardInterrupt:
                self.interrupt()
                self._process.wait()
            raise

    def refuse_no_flight(self) -> None:
        """Check that it has flown, whatever the verdict is.

        Raises:
            ConfigError, StartError, MissionError: it has ended without a flight, with its own words.
        """
        code = self._process.poll()
        if code is None or code in _FLEW:
            return
        lines = read_file(self._log, _MAX_LOG_BYTES).decode(errors="replace").strip().splitlines()
        raise _error_of(code, self._name, "\n".join(lines[-_LINES_TOLD:]))


def _error_of(code: int, name: str, text: str) -> SwarmError:
    """Return the error that an exit code of the command line stands for."""
    said = text or f"{name} ended with exit code {code}"
    if code == EXIT_USAGE:
        return ConfigError(name, said.splitlines())
    return StartError(said) if code == EXIT_START else MissionError(said)
