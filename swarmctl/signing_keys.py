"""Files of signing keys that a configuration names: where they are, and why they can't be used.

The resolved configuration holds their absolute names, never a key.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from swarmctl.core.text import printable
from swarmctl.errors import ConfigError
from swarmctl.mavlink.signing.key_file import read_key
from swarmctl.mavlink.signing.signature import SigningKey

KEY = "mavlink.signing_keys"
_MOST_SHOWN = 200


def locate_keys(tree: dict[str, Any], folder: Path) -> None:
    """Make the names of key files absolute; links are not followed.

    Args:
        tree: a configuration, whose form is checked later.
        folder: folder that relative names are relative to.
    """
    section = tree.get("mavlink")
    names = section.get("signing_keys") if isinstance(section, dict) else None
    if isinstance(section, dict) and isinstance(names, list) and all(isinstance(name, str) for name in names):
        section["signing_keys"] = [str((folder / name).absolute()) if name else name for name in names]


def locate_identities(tree: dict[str, Any], folder: Path) -> None:
    """Make the name of the folder of identities absolute; arguments as of `locate_keys`."""
    section = tree.get("bus")
    name = section.get("identities") if isinstance(section, dict) else None
    if isinstance(section, dict) and isinstance(name, str) and name:
        section["identities"] = str((folder / name).absolute())


def key_problems(names: Sequence[str], agents: int, only: Collection[int] | None = None) -> Iterator[str]:
    """Yield why the named files are not a key for each of so many vehicles; none for no names.

    Args:
        names: files in the order of the agents.
        agents: number of agents.
        only: the agents whose keys are needed here; None: all.
    """
    if names and len(names) < agents:
        yield f"{KEY}: {len(names)} files for swarm.agents = {agents}; list one for each vehicle (swarmctl keys new)"
    owners: dict[str, int] = {}
    for number, name in enumerate(names[:agents]):
        if only is not None and number not in only:
            continue
        try:
            fingerprint = read_key(Path(name)).fingerprint
        except OSError as error:
            yield (
                f"{KEY}.{number} = {printable(name, _MOST_SHOWN)!r}: {error.strerror}; give a file of mode 0600 as "
                "written by swarmctl keys new"
            )
            continue
        if fingerprint in owners:
            yield f"{KEY}.{number}: holds the same key as {KEY}.{owners[fingerprint]}; give every vehicle its own"
        owners.setdefault(fingerprint, number)


def read_keys(names: Sequence[str], agents: int) -> list[SigningKey | None]:
    """Return the key of each vehicle; None for each where nothing is signed.

    Raises:
        ConfigError: a file can't be used; lists all problems.
    """
    if problems := list(key_problems(names, agents)):
        raise ConfigError("signing keys", problems)
    return [read_key(Path(name)) for name in names[:agents]] if names else [None] * agents


def read_own_key(names: Sequence[str], agent: int) -> SigningKey | None:
    """Return the key of one agent's vehicle; None where nothing is signed. Other vehicles' keys may be elsewhere.

    Raises:
        ConfigError: its file can't be used.
    """
    if problems := list(key_problems(names, agent + 1, only=(agent,))):
        raise ConfigError("signing keys", problems)
    return read_key(Path(names[agent])) if names else None
