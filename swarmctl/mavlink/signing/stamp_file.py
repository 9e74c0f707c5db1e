"""Time stamps of signed links between one start of a program and the next, in the user's state directory.

One small file for each key and link id, named by the key's fingerprint. A program that is killed has written the last
seconds ahead: its successor never signs with a time stamp again.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from swarmctl.errors import StartError
from swarmctl.files import read_file, replace_bytes
from swarmctl.mavlink.signing.channel import SigningChannel, Stamps
from swarmctl.mavlink.signing.signature import STAMPS_PER_S, SigningKey, Stream

_MOST_BYTES = 100_000
_PERIOD_S = 5.0
_RESERVED = 2 * round(_PERIOD_S) * STAMPS_PER_S  # written ahead while a program signs
_CLOSE_S = 2.0


class _Row(msgspec.Struct, frozen=True, array_like=True):
    link_id: int
    sysid: int
    compid: int
    stamp: int


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sent: int
    received: tuple[_Row, ...]


def state_folder() -> Path:
    """Return the folder of all files of this module."""
    given = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (given if given.is_absolute() else Path.home() / ".local" / "state") / "swarmctl" / "signing"


class StampFile:
    """The file of one key and link id.

    Args:
        folder: folder of the file, created when it does not exist.
        key: names the file.
        link_id: of the frames that the program sends.
    """

    def __init__(self, folder: Path, key: SigningKey, link_id: int) -> None:
        self._folder, self._key = folder, key
        self._path = folder / f"{key.fingerprint}-{link_id}.json"

    def load(self) -> Stamps:
        """Return the newest time stamps of every program that has used the key.

        Raises:
            StartError: a file can't be read.
        """
        sent, received = 0, dict[Stream, int]()
        for path in sorted(self._folder.glob(f"{self._key.fingerprint}-*.json")):
            try:
                content = msgspec.json.decode(read_file(path, _MOST_BYTES), type=_Content)
            except (OSError, msgspec.DecodeError) as error:
                raise StartError(
                    f"{path}: can't be read: {error}. Old MAVLink frames could be replayed: give the vehicle a new key "
                    "(swarmctl keys), or remove the file"
                ) from error
            sent = max(sent, content.sent)
            for row in content.received:
                stream = Stream(row.link_id, row.sysid, row.compid)
                received[stream] = max(row.stamp, received.get(stream, 0))
        return Stamps(sent=sent, received=received)

    def save(self, stamps: Stamps) -> None:
        """Replace the file.

        Raises:
            OSError: the disk refuses; the old file is untouched.
        """
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        rows = tuple(_Row(*stream, stamp) for stream, stamp in stamps.received.items())
        replace_bytes(self._path, msgspec.json.encode(_Content(stamps.sent, rows)))


class StampKeeper:
    """Saves the time stamps of a channel every few seconds in a thread of its own, and at the end.

    Args:
        file: where to.
        newest: returns the time stamps now.

    Raises:
        StartError: the file can't be written.
    """

    def __init__(self, file: StampFile, newest: Callable[[], Stamps]) -> None:
        self._file, self._newest = file, newest
        try:
            self._save_ahead()
        except OSError as error:
            raise StartError(
                f"time stamps of signed frames can't be saved: {error}. Make room, or set XDG_STATE_HOME"
            ) from error
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stamp-keeper", daemon=True)
        self._thread.start()

    def close(self) -> str:
        """Save for the last time; return why that was not possible, or ""."""
        self._stop.set()
        self._thread.join(_CLOSE_S)
        try:
            self._file.save(self._newest())
        except OSError as error:
            return f"time stamps of signed frames could not be saved: {error}"
        return ""

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            try:
                self._save_ahead()
            except OSError:
                continue  # the reserve lasts for a while; `close` tells

    def _save_ahead(self) -> None:
        newest = self._newest()
        self._file.save(Stamps(sent=newest.sent + _RESERVED, received=newest.received))


@contextlib.contextmanager
def kept_channel(key: SigningKey, link_id: int, utc_us: Callable[[], int]) -> Iterator[SigningChannel]:
    """Yield a channel that knows the time stamps of earlier programs, and keep its own for later ones.

    Raises:
        StartError: the files of time stamps can't be read or written.
    """
    file = StampFile(state_folder(), key, link_id)
    channel = SigningChannel(key, link_id, utc_us, file.load())
    keeper = StampKeeper(file, channel.stamps)
    try:
        yield channel
    finally:
        if problem := keeper.close():
            print(problem, file=sys.stderr)
