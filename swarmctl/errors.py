"""One exception tree; every branch is one exit code of the command line.

Exceptions live at the borders (config, start-up, files). Inside a tick a failure is a value.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from swarmctl.core.text import printable, printable_lines

EXIT_OK = 0
EXIT_USAGE = 2
EXIT_START = 3
EXIT_MISSION = 4
EXIT_INTERRUPTED = 130
_MAX_CHARACTERS = 2000  # characters of one problem


class SwarmError(Exception):
    """Anything the command line reports in words instead of a traceback."""

    exit_code = EXIT_MISSION


class ConfigError(SwarmError):
    """Bad usage or configuration; carries every problem found, not only the first."""

    exit_code = EXIT_USAGE

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        self.source = source
        self.problems = tuple(problems)
        super().__init__("\n".join(printable(f"{source}: {problem}", _MAX_CHARACTERS) for problem in self.problems))


class StartError(SwarmError):
    """A process, port, vehicle or link that was needed did not come up."""

    exit_code = EXIT_START


class MissionError(SwarmError):
    """The flight began and did not end as asked, or a limit was violated."""

    exit_code = EXIT_MISSION


def exit_code_of(run: Callable[[], int], when_interrupted: str = "") -> int:
    """What `run` returns; of an error, in words on standard error, and of Ctrl-C the exit code that says so."""
    try:
        return run()
    except SwarmError as error:
        print(printable_lines(str(error)), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        if when_interrupted:
            print(when_interrupted, file=sys.stderr)
        return EXIT_INTERRUPTED
