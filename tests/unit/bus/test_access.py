"""What a router lets each link bring, and send there: the access control that it gives to Zenoh, played through."""

from __future__ import annotations

import re
from typing import Any

import pytest

from swarmctl.bus.network.access import access_settings
from swarmctl.bus.network.hosts import HostParams, roster_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.topics import TOPICS

HOSTS = tuple(
    HostParams(name=name, address=f"10.0.0.{i + 1}:7448", agents=(i,), operator=name == "charlie")
    for i, name in enumerate(("alpha", "bravo", "charlie"))
)
NAMES = (*(host.name for host in HOSTS), STATION)
COMMON_NAMES = {name: f"{name}.1a2b" for name in NAMES}
LOSSY = {topic.name for topic in TOPICS if not topic.reliable}
ALL = {*(topic.name for topic in TOPICS), "alive"}
OF_AGENTS = {"answer", "event", "alive"}
ORDERS = {"command", "mission", "obstacles"}


class Router:
    """Applies the access control of one identity's router as Zenoh does."""

    def __init__(self, me: str, *, relay: bool = False, common_names: dict[str, str] = COMMON_NAMES) -> None:
        self.control = access_settings(roster_of(HOSTS, relay=relay), me, common_names)["access_control"]
        self._rules = {rule["id"]: rule for rule in self.control["rules"]}

    def allows(self, flow: str, message: str, key: str, **end: str) -> bool:
        """Tell whether a message passes between this router and an end that is given by what proves it."""
        subjects = [one["id"] for one in self.control["subjects"] if self._is(one, **end)]
        names = {name for one in self.control["policies"] if {*one["subjects"]} & {*subjects} for name in one["rules"]}
        return any(
            flow in rule["flows"] and message in rule["messages"] and any(covers(e, key) for e in rule["key_exprs"])
            for rule in map(self._rules.__getitem__, names)
        )

    @staticmethod
    def _is(subject: dict[str, Any], *, protocol: str = "quic", common_name: str = "") -> bool:
        proves = "cert_common_names" not in subject or common_name in subject["cert_common_names"]
        return proves and ("link_protocols" not in subject or protocol in subject["link_protocols"])

    def brings(self, sender: str, message: str = "put", **end: str) -> set[str]:
        """Return the topics that an end may bring under the name of a sender."""
        return {topic for topic in ALL if self.allows("ingress", message, f"swarm/run-1/{sender}/{topic}", **end)}


def covers(expression: str, key: str) -> bool:
    parts = (".*" if part == "**" else "[^/]*" if part == "*" else re.escape(part) for part in expression.split("/"))
    return re.fullmatch("/".join(parts), key) is not None


def link_of(name: str) -> dict[str, str]:
    return {"common_name": COMMON_NAMES[name]}


OWN_CLIENT = {"protocol": "unixsock-stream"}


def test_what_no_rule_allows_is_denied() -> None:
    control = Router("alpha").control
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    assert {rule["permission"] for rule in control["rules"]} == {"allow"}


@pytest.mark.parametrize("message", ["put", "delete", "liveliness_token", "declare_queryable", "reply"])
def test_a_host_brings_what_its_agents_answer_and_that_they_have_ended(message: str) -> None:
    router = Router("alpha")
    assert router.brings("agent-1", message, **link_of("bravo")) == OF_AGENTS
    assert router.brings("bravo", message, **link_of("bravo")) == {"ended", "alive"}


@pytest.mark.parametrize("sender", ["alpha", "agent-0", "charlie", "agent-2", STATION, "operator"])
def test_a_host_brings_nothing_under_the_names_of_others(sender: str) -> None:
    assert Router("alpha").brings(sender, **link_of("bravo")) == set()


@pytest.mark.parametrize("me", ["alpha", "bravo", "charlie"])
@pytest.mark.parametrize("operator", ["charlie", STATION])
def test_operators_bring_orders_to_every_host(me: str, operator: str) -> None:
    if me != operator:
        assert Router(me).brings(operator, **link_of(operator)) == {"ended", "alive", *ORDERS}


def test_what_another_host_keeps_clear_of_comes_to_who_may_change_the_list_alone() -> None:
    assert Router("charlie").brings("bravo", **link_of("bravo")) == {"ended", "alive", "obstacles"}
    assert Router(STATION).brings("bravo", **link_of("bravo")) == {"ended", "alive", "obstacles"}


def test_own_clients_say_what_this_computer_may_say() -> None:
    router = Router("alpha")
    assert router.brings("agent-0", **OWN_CLIENT) == LOSSY | OF_AGENTS
    assert router.brings("alpha", **OWN_CLIENT) == {"ended", "alive", *ORDERS}, "a host commands its own agents"
    for sender in ("bravo", "agent-1", STATION):
        assert router.brings(sender, **OWN_CLIENT) == set()


@pytest.mark.parametrize("common_name", ["", "bravo", "bravo.0000", "mallory.1a2b"])
def test_who_proves_no_trusted_identity_brings_and_hears_nothing(common_name: str) -> None:
    router = Router("alpha")
    for sender in (*NAMES, "agent-0", "agent-1", "agent-2"):
        assert router.brings(sender, common_name=common_name) == set()
    assert not router.allows("ingress", "declare_subscriber", "swarm/run-1/agent-0/path", common_name=common_name)
    assert not router.allows("egress", "put", "swarm/run-1/alpha/command", common_name=common_name)


def test_a_revoked_identity_has_no_rights_and_the_own_clients_keep_theirs() -> None:
    trusted = {name: known for name, known in COMMON_NAMES.items() if name not in ("alpha", "bravo")}
    router = Router("alpha", common_names=trusted)
    assert router.brings("agent-1", **link_of("bravo")) == set()
    assert router.brings("agent-0", **OWN_CLIENT) == LOSSY | OF_AGENTS


@pytest.mark.parametrize("relay", [False, True])
def test_where_routers_pass_on_what_others_say_a_link_may_bring_it_and_own_clients_may_not(relay: bool) -> None:
    router = Router("alpha", relay=relay)
    assert router.brings("agent-2", **link_of("bravo")) == (OF_AGENTS if relay else set())
    assert router.brings(STATION, **link_of("bravo")) == ({"ended", "alive", *ORDERS} if relay else set())
    assert router.brings("mallory", **link_of("bravo")) == set()
    assert router.brings("agent-2", **OWN_CLIENT) == set()


def test_links_carry_no_message_that_may_be_lost_and_own_clients_hear_everything() -> None:
    router = Router("alpha")
    for end, sent in ((link_of("bravo"), ALL - LOSSY), (OWN_CLIENT, ALL)):
        for message in ("put", "declare_subscriber"):
            heard = {topic for topic in ALL if router.allows("egress", message, f"swarm/run-1/agent-2/{topic}", **end)}
            assert heard == sent


def test_whoever_is_trusted_may_listen() -> None:
    for end in (link_of("bravo"), OWN_CLIENT):
        for message in ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query"):
            assert Router("alpha").allows("ingress", message, "swarm/run-1/agent-2/path", **end)
