"""A bus in memory whose messages are sealed, as between hosts."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from swarmctl.bus.bus import Bus, Subscriptions, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.network.hosts import HostParams, roster_of
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.keyring import load_keyring
from swarmctl.bus.network.roster import OwnIdentity, Roster, Speaker
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US, SealedBus
from swarmctl.bus.network.seals import PairKeys, Sealer, SealVerifier
from swarmctl.bus.topics import OPERATOR

RUN = "run"
_LOOPBACK = ipaddress.ip_address("127.0.0.1")


@dataclass(frozen=True, kw_only=True)
class SealedHub:
    """Identities of hosts, and of the operator of a flight in lockstep.

    Attributes:
        roster: these.
        keys: of each identity, by name.
    """

    roster: Roster
    keys: dict[str, PairKeys]

    @classmethod
    def of(cls, hosts: Sequence[HostParams], folder: Path) -> SealedHub:
        """Make the identities of hosts and the operator in a folder."""
        operator = Speaker(name=OPERATOR, agents=(), senders=(OPERATOR,), operator=True)
        roster = Roster(speakers=(*roster_of(hosts, relay=False).speakers[:-1], operator), relay=False)
        names = [speaker.name for speaker in roster.speakers]
        make_identities(folder, {**dict.fromkeys(names, _LOOPBACK), OPERATOR: None})
        identities = {name: OwnIdentity(folder=str(folder), name=name, roster=roster) for name in names}
        return cls(roster=roster, keys={name: load_keyring(own).keys for name, own in identities.items()})

    @property
    def connect(self) -> Callable[[LocalHub, str, Subscriptions | None], Bus]:
        """Return a `LocalHub.connect` whose participants seal what they say, each as the host that it runs on."""
        plain = LocalHub.connect
        host_of = {agent_name(agent): host.name for host in self.roster.speakers for agent in host.agents}

        def connected(hub: LocalHub, name: str, subscriptions: Subscriptions | None = None) -> Bus:
            me = host_of.get(name, OPERATOR)
            verifier = SealVerifier(self.roster, self.keys[me], RUN, me=me, max_age_us=FOR_AGENTS_US)
            return SealedBus(plain(hub, name, subscriptions), self.sealer(me, name), verifier, hub.now_us)

        return connected

    def sealer(self, identity: str, sender: str) -> Sealer:
        """Return what seals messages under a name, by the keys of an identity."""
        return Sealer(self.keys[identity], RUN, sender, session=1)
