"""Exceptions of the program in one tree; every class has one exit code of the command line.

Exceptions are raised at the borders (configuration, start-up, files). Inside a tick a failure is a value.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from swarmctl.core.text import printable, printable_lines
from swarmctl.standard_streams import finish_output, prepare_standard_streams

EXIT_OK = 0
EXIT_USAGE = 2
EXIT_START = 3
EXIT_MISSION = 4
EXIT_INTERRUPTED = 130
_MAX_CHARACTERS = 2000  # characters of one problem


class SwarmError(Exception):
    """Base of errors that the command line reports in words instead of a traceback."""

    exit_code = EXIT_MISSION


class ConfigError(SwarmError):
    """Wrong usage or configuration; carries every problem found, not only the first."""

    exit_code = EXIT_USAGE

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        self.source = source
        self.problems = tuple(problems)
        super().__init__("\n".join(printable(f"{source}: {problem}", _MAX_CHARACTERS) for problem in self.problems))

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, tuple[str, ...]]]:
        """Let another process raise it."""
        return type(self), (self.source, self.problems)


class StartError(SwarmError):
    """A required process, port, vehicle or link did not come up."""

    exit_code = EXIT_START


class MissionError(SwarmError):
    """The flight began but its mission failed, or a limit was violated."""

    exit_code = EXIT_MISSION


def exit_code_of(run: Callable[[], int], when_interrupted: str = "") -> int:
    """Run `run` and return its exit code; errors go to standard error, Ctrl-C gives `EXIT_INTERRUPTED`.

    Success is `EXIT_MISSION` where the disk had no room for what was printed.
    """
    prepare_standard_streams()
    code = _reported(run, when_interrupted)
    if problem := finish_output():
        print(problem, file=sys.stderr)
        return code or EXIT_MISSION
    return code


def _reported(run: Callable[[], int], when_interrupted: str) -> int:
    try:
        return run()
    except SwarmError as error:
        print(printable_lines(str(error)), file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        if when_interrupted:
            print(when_interrupted, file=sys.stderr)
        return EXIT_INTERRUPTED
