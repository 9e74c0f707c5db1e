"""Joins the bus of a run: sealed on several computers, plain where one launch has a private socket for itself."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from swarmctl.bus.bus import DEFAULT_LEASE_MS, Bus
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.network.sealed_bus import SealedBus
from swarmctl.bus.network.seals import Sealer, SealVerifier, overhead_bytes
from swarmctl.bus.topics import Topic
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import CONNECT_TIMEOUT_MS
from swarmctl.bus.zenoh.session import ZenohSession


def join_bus(
    endpoint: str,
    run: str,
    me: str,
    subscriptions: Mapping[Topic, Sequence[str]],
    *,
    identity: OwnIdentity | None,
    max_age_us: Mapping[str, int],
    utc_us: Callable[[], int],
    lease_ms: int = DEFAULT_LEASE_MS,
    connect_timeout_ms: int = CONNECT_TIMEOUT_MS,
    carrier: Callable[[Bus], Bus] = lambda bus: bus,
    opens: Callable[..., ZenohSession] = ZenohSession,
) -> Bus:
    """Join the bus of a run.

    Args:
        endpoint, run, me, subscriptions, lease_ms, connect_timeout_ms, opens: see `ZenohBus`.
        identity: as which messages are sealed; None: they are not.
        max_age_us: see `SealVerifier`.
        utc_us: own clock.
        carrier: carries messages as they are sent, sealed or not, by the bus that it is given.

    Raises:
        StartError: the router does not answer in time.
        ConfigError: the identity can't be used.
    """
    open_bus = partial(
        ZenohBus,
        endpoint,
        run,
        me,
        subscriptions,
        lease_ms=lease_ms,
        connect_timeout_ms=connect_timeout_ms,
        opens=opens,
    )
    if identity is None:
        return carrier(open_bus())
    from swarmctl.bus.network.keyring import load_keyring  # loads cryptography, which one computer alone does not need

    keys, roster = load_keyring(identity).keys, identity.roster
    bus = open_bus(seal_bytes=overhead_bytes(roster))
    sealer = Sealer(keys, run, me, session=secrets.randbits(64))
    verifier = SealVerifier(roster, keys, run, me=identity.name, max_age_us=max_age_us)
    return SealedBus(carrier(bus), sealer, verifier, utc_us)
