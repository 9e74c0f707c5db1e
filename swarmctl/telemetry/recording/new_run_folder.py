"""Creates the folder of a run before the flight, and keeps others from flying into it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from swarmctl.errors import ConfigError, StartError
from swarmctl.files import hold, is_held, replace_text
from swarmctl.telemetry.evaluation.referee import RunMode
from swarmctl.telemetry.recording.file_names import (
    AGENT_FILE,
    CONFIG,
    EVENTS,
    PACKED_TRUTH,
    RECORDING,
    STUDY_ROWS,
    SUMMARY,
    TRUTH,
    events_file,
)
from swarmctl.telemetry.recording.kept_outcome import reserve_outcome
from swarmctl.telemetry.report.run_report import REPORT

_LAUNCHES_PER_SECOND = 1000
_TAKEN = frozenset((EVENTS, SUMMARY, TRUTH, PACKED_TRUTH, RECORDING, REPORT, STUDY_ROWS))
_JUST_BEGUN = "another run has just begun there. Choose a new folder"


def create_run_folder(
    base: Path | None, name: str, utc_us: int, *, advice: str = "Choose another with --run-dir"
) -> Path:
    """Create and return the folder of a new run.

    Args:
        base: the folder itself; None for `runs/<UTC>-<name>`, with a number appended if that name is taken.
        name: name of the configuration.
        utc_us: start of the run [us since 1970].
        advice: what to do where it can't be made.

    Raises:
        ConfigError: `base` contains a run already, or a symbolic link through which files would be written, is a file
            or within one, or its name is no text.
        StartError: the folder can't be created.
    """
    try:
        if base is not None:
            str(base).encode()  # names that are no text could be written to no file of the run
            base.mkdir(parents=True, exist_ok=True)
            _refuse_taken(base)
            if is_held(base.resolve()):  # by a run that begins, and has no other files yet
                raise ConfigError(f"--run-dir {base}", [_JUST_BEGUN])
            return base
        stamp = datetime.fromtimestamp(utc_us / 1e6, UTC).strftime("%Y%m%dT%H%M%SZ")
        Path("runs").mkdir(exist_ok=True)
        for attempt in range(1, _LAUNCHES_PER_SECOND):
            path = Path("runs") / (f"{stamp}-{name}" if attempt == 1 else f"{stamp}-{name}-{attempt}")
            with contextlib.suppress(FileExistsError):
                path.mkdir(exist_ok=False)
                return path
    except UnicodeEncodeError as error:
        raise ConfigError("--run-dir", [f"{base!r} is no text in UTF-8. Choose another name"]) from error
    except OSError as error:
        if base is not None and isinstance(error, FileExistsError | NotADirectoryError):
            raise ConfigError(f"--run-dir {base}", ["is a file, or within one. Choose another folder"]) from error
        raise StartError(f"run folder can't be made: {error}. {advice}") from error
    raise StartError(f"runs/{stamp}-{name}: {_LAUNCHES_PER_SECOND} launches in one second")


def _refuse_taken(base: Path) -> None:
    links = sorted(path.name for path in base.iterdir() if path.is_symlink())
    if links:
        raise ConfigError(f"--run-dir {base}", [f"holds a symbolic link ({links[0]}). Choose a new folder or empty it"])
    taken = sorted(path.name for path in base.iterdir() if _is_recorded(path.name))
    if taken:
        raise ConfigError(f"--run-dir {base}", [f"holds a run already ({taken[0]}). Choose a new folder or empty it"])


def _is_recorded(name: str) -> bool:
    """Return whether a file of a run folder is there only once a run has begun."""
    return name in _TAKEN or name.endswith(events_file("")) or bool(AGENT_FILE.match(name))


def write_config(directory: Path, text: str, mode: RunMode = "realtime") -> None:
    """Write the resolved configuration of a new run into its folder, and keep room there for how it ends.

    Args:
        directory: the run folder.
        text: the configuration.
        mode: how it is flown, which a run that is cut off could not tell later.

    Raises:
        ConfigError: another configuration is there, which may be the user's own.
        OSError: it can't be written.
    """
    path = directory / CONFIG
    if path.exists() and path.read_text(encoding="utf-8", errors="replace") != text:
        raise ConfigError(f"--run-dir {directory}", [f"holds another {CONFIG}. Choose a new folder or move that file"])
    replace_text(path, text)
    reserve_outcome(directory, mode)


@contextlib.contextmanager
def held_run(directory: Path) -> Iterator[None]:
    """Keep others from flying into the folder of a new run, and from finishing it while its rows are in memory.

    Of several that begin at once in one folder, `create_run_folder` accepts each; one alone comes to hold it.

    Raises:
        ConfigError: another run has it, or had it meanwhile.
    """
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        if not hold(fd):
            raise ConfigError(f"--run-dir {directory}", [_JUST_BEGUN])
        _refuse_taken(directory)
        yield
    finally:
        os.close(fd)
