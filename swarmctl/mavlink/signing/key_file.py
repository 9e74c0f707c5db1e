"""Key files: 64 hexadecimal digits on one line, which only their owner may read."""

from __future__ import annotations

import re
import secrets
from pathlib import Path

from swarmctl.files import create_private, read_file
from swarmctl.mavlink.signing.signature import KEY_BYTES, SigningKey

_MOST_BYTES = 200
_LINE = re.compile(rb"[0-9a-fA-F]{%d}\n?" % (2 * KEY_BYTES))


def read_key(path: Path) -> SigningKey:
    """Return the key in a file.

    Raises:
        OSError: there is no such file, it is not a regular one, others may read it, or it holds no key.
    """
    content = read_file(path, _MOST_BYTES, private=True)
    if not _LINE.fullmatch(content):
        raise OSError(0, f"holds no key: {2 * KEY_BYTES} hexadecimal digits on one line", str(path))
    return SigningKey(bytes.fromhex(content.decode().strip()))


def write_new_key(path: Path) -> SigningKey:
    """Write a new random key to a new file of mode 0600, and return it.

    Raises:
        OSError: the file exists, or can't be written.
    """
    key = SigningKey(secrets.token_bytes(KEY_BYTES))
    create_private(path, key.secret.hex().encode() + b"\n")
    return key
