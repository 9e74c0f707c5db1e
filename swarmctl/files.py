"""Files at the border: read only what is a file of bounded size, replace in one step, never write through a link.

A run folder, a campaign or a configuration may come from somebody else. What lies in it under an expected name can be
a pipe that never ends, a device, or a symbolic link to a file of ours.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_CREATE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def read_file(path: Path, most_bytes: int, follow: bool = False) -> bytes:
    """Content of a regular file.

    Args:
        path: of the file.
        most_bytes: a larger file is refused before it is read.
        follow: whether `path` itself may be a symbolic link.

    Raises:
        FileNotFoundError: there is none.
        OSError: it is something else than a regular file, is larger, or can't be read; `strerror` says which.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)  # a pipe must not block
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
    with os.fdopen(fd, "rb") as file:
        content = file.read(most_bytes + 1) if status.st_size <= most_bytes else b""
        if status.st_size > most_bytes or len(content) > most_bytes:
            raise OSError(errno.EFBIG, f"is larger than {most_bytes / 1e6:g} MB", str(path))
        return content


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """A new file that becomes `path` when the block ends well: a reader, or a crash, finds the old one or the new one.

    A symbolic link at `path` is replaced itself; what it points to stays as it is.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
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
    """Write a whole file in one step.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    with replaced(path) as file:
        file.write(content)


def replace_text(path: Path, text: str) -> None:
    """Write a whole file of UTF-8 text in one step; what UTF-8 has no bytes for becomes a question mark.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    replace_bytes(path, text.encode(errors="replace"))


@contextmanager
def replaced_by_program(path: Path) -> Iterator[Path]:
    """A path that another program may write, in a private folder beside `path`, and that becomes `path` if it did.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        part = Path(folder) / path.name
        yield part
        with contextlib.suppress(FileNotFoundError):
            part.replace(path)


def write_each(writers: Mapping[str, Callable[[], object]]) -> tuple[str, ...]:
    """Call every writer, whatever becomes of the others; returns what the disk did not take, by name, in words."""
    unwritten = []
    for name, write in writers.items():
        try:
            write()
        except OSError as error:
            unwritten.append(f"{name}: {error.strerror or error}")
    return tuple(unwritten)
