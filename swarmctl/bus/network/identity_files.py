"""The files of a swarm's identities: an authority, what it has revoked, a certificate and a key for every computer.

Only this module knows their names. Zenoh reads them for the router's links, `swarmctl.bus.network.keyring` for seals
and rights; `swarmctl.bus.network.identities` makes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from swarmctl.files import read_file

AUTHORITY = "authority"  # signs the others; its key is needed to add a host, on no host to fly
STATION = "station"
REVOKED_FILE = "revoked.pem"  # list of certificates that count no more, signed by the authority
MOST_BYTES = 20_000


def certificate_file(name: str) -> str:
    """Return the file name of a certificate."""
    return f"{name}.pem"


def key_file(name: str) -> str:
    """Return the file name of a private key."""
    return f"{name}.key"


def identity_problems(folder: Path, name: str) -> Iterator[str]:
    """Yield why a computer can't prove that it belongs to the swarm."""
    for file, private in (
        (certificate_file(AUTHORITY), False),
        (certificate_file(name), False),
        (key_file(name), True),
    ):
        try:
            read_file(folder / file, MOST_BYTES, private=private)
        except OSError as error:
            mode = ", a file of mode 0600" if private else ""
            fix = f"copy it{mode} from the computer on which swarmctl keys init CONFIG has made it"
            yield f"bus.identities: {folder / file}: {error.strerror}; {fix}"
