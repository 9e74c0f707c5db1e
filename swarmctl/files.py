"""Safe file access: reads only regular files of bounded size, replaces files atomically, never writes through links.

A run folder, a campaign or a configuration may come from another person. A file in it with an expected name can be a
pipe that never ends, a device, or a symbolic link to a private file.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from swarmctl.errors import ConfigError, StartError

_CREATE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def read_file(path: Path, most_bytes: int, follow: bool = False, private: bool = False) -> bytes:
    """Return the content of a regular file.

    Args:
        path: path of the file.
        most_bytes: largest size; a larger file is refused before it is read.
        follow: whether `path` itself may be a symbolic link.
        private: whether a file that anybody but this user may read or write is refused.

    Raises:
        FileNotFoundError: the file does not exist.
        OSError: it is not a regular file, is larger, not private, or can't be read; `strerror` says which.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)  # opening a pipe would block
    try:
        fd = os.open(path, flags)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(errno.ELOOP, "is a symbolic link, not a file", str(path)) from error
        raise
    status = os.fstat(fd)
    if not stat.S_ISREG(status.st_mode):
        os.close(fd)
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    if private and (wrong := _why_not_private(status)):
        os.close(fd)
        raise OSError(errno.EPERM, wrong, str(path))
    with os.fdopen(fd, "rb") as file:
        content = file.read(most_bytes + 1) if status.st_size <= most_bytes else b""
        if status.st_size > most_bytes or len(content) > most_bytes:
            raise OSError(errno.EFBIG, f"is larger than {most_bytes / 1e6:g} MB", str(path))
        return content


def _why_not_private(status: os.stat_result) -> str:
    """Return why others may read or write a file, or ""."""
    if status.st_uid != os.geteuid():
        return "belongs to another user"
    if stat.S_IMODE(status.st_mode) & 0o077:
        return f"has mode {stat.S_IMODE(status.st_mode):04o}, so that others may read or write it; chmod 600 it"
    return ""


def hold(fd: int) -> bool:
    """Mark an open file or folder as one that is still written, until it is closed or the process ends; see `is_held`.

    Returns:
        whether it is marked for this process; False: another one has marked it.
    """
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks must not cost what is written
    return True


def is_held(path: Path) -> bool:
    """Return whether a process still writes to what it has marked; not known of what can't be opened."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(fd)
    return False


def create_private(path: Path, content: bytes) -> None:
    """Write a new file that only this user may read.

    Raises:
        OSError: the file exists, or the disk refuses; nothing is left of it.
    """
    fd = os.open(path, _CREATE_FLAGS, 0o600)
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(fd)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that atomically becomes `path` when the block ends without an exception.

    A symbolic link at `path` is itself replaced; its target stays as it is.

    Raises:
        OSError: it is a folder, a device or a pipe, or writing failed; the old file is untouched.
    """
    if path.exists() and not path.is_file():  # root would replace even /dev/null, or what a link to it is for
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    fd = os.open(part, _CREATE_FLAGS, 0o644)
    try:
        with os.fdopen(fd, "wb") as file:
            yield file
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def replace_bytes(path: Path, content: bytes) -> None:
    """Write a whole file atomically.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    with replaced(path) as file:
        file.write(content)


def replace_text(path: Path, text: str) -> None:
    """Write a whole file of UTF-8 text atomically; lone surrogates become question marks.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    replace_bytes(path, text.encode(errors="replace"))


@contextmanager
def replaced_by_program(path: Path) -> Iterator[Path]:
    """Yield a path in a private folder for another program to write to; if it did, the file becomes `path`.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        part = Path(folder) / path.name
        yield part
        with contextlib.suppress(FileNotFoundError):
            part.replace(path)


def write_each(writers: Mapping[str, Callable[[], object]]) -> tuple[str, ...]:
    """Call every writer even if others fail; returns one line "name: reason" for each failure."""
    unwritten = []
    for name, write in writers.items():
        try:
            write()
        except OSError as error:
            unwritten.append(f"{name}: {error.strerror or error}")
    return tuple(unwritten)


def write_new(texts: Mapping[Path, str]) -> None:
    """Write files that do not exist yet: all or none.

    Raises:
        ConfigError: there is one.
        StartError: one can't be written.
    """
    for path in texts:
        if os.path.lexists(path):
            raise ConfigError(str(path), ["exists already; give another name, or go to another folder"])
    for path, text in texts.items():
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            advice = "Give another name, or make its folder"
            raise StartError(f"{path}: can't be written: {error.strerror}. {advice}") from error
