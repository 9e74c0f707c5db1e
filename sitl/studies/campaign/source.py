"""Identity of the code that flew a trial: a digest of the sources that can change its result, the user's own too."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from swarmctl.own_modules import own_sources

_PACKAGES = ("sitl", "swarmctl")
_STUDIES = ("campaign", "sweep")
_PAGES = {
    "page.py",
    "progress.py",
    "store.py",
    "worker_pool.py",
    "summary.py",
    "command.py",
}  # modules of these studies that do not affect a flight


@cache
def code_id() -> str:
    """Return 12 hexadecimal digits of SHA-256 over every module of the simulator and the bridge."""
    root = Path(__file__).parents[3]
    digest = hashlib.sha256()
    for path in sorted(path for package in _PACKAGES for path in (root / package).rglob("*.py")):
        if path.parent.name in _STUDIES and path.name in _PAGES:
            continue
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def own_digest(folder: str) -> str:
    """Return a digest of the own modules that this process has imported from a folder; "" for none."""
    digest, own = hashlib.sha256(), own_sources(folder)
    for path in own:
        digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest() if own else ""


def code_of(own: str) -> str:
    """Return the digest of the sources that fly: those of `code_id`, and own modules by their `own_digest`."""
    return hashlib.sha256(f"{code_id()} {own}".encode()).hexdigest()[:12] if own else code_id()
