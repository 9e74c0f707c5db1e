"""What a router lets pass, by the certificate at the other end of a link: Zenoh's access control. Pure.

The common name of a certificate differs from that of every other one, also of the same computer's earlier ones, so an
identity that has been replaced or revoked has no rights left. Clients on the Unix socket are of the router's own user.
Rights can't be changed while a router runs (zenoh #2169).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from swarmctl.bus.network.roster import Roster, Speaker
from swarmctl.bus.topics import ANSWER, COMMAND, ENDED, EVENT, MISSION, OBSTACLES, TOPICS

_LISTENING = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query")
_SPEAKING = ("put", "delete", "liveliness_token", "declare_queryable", "reply")
_ALIVE = "alive"  # of liveliness tokens
_LINKED = (*(topic.name for topic in TOPICS if topic.reliable), _ALIVE)  # what links of routers carry
_OF_AGENTS = (ANSWER.name, EVENT.name, _ALIVE)
_OF_CLIENTS = (*(topic.name for topic in TOPICS if not topic.reliable), *_OF_AGENTS)
_OF_COMPUTERS = (ENDED.name, _ALIVE)
_OF_OPERATORS = (COMMAND.name, MISSION.name, OBSTACLES.name)
_EVERYTHING = "swarm/**"
_LOCAL = "unixsock-stream"


def access_settings(roster: Roster, me: str, common_names: Mapping[str, str]) -> dict[str, Any]:
    """Return the access control of the router of one identity.

    Args:
        roster: everybody.
        me: name of the identity whose router it is.
        common_names: of the trusted certificates, by identity; who is not listed may say nothing.
    """
    rules = [_rule("send", "egress", (*_SPEAKING, *_LISTENING), [_EVERYTHING])]
    rules += [_rule("link", "egress", (*_SPEAKING, *_LISTENING), [f"swarm/*/*/{name}" for name in _LINKED])]
    rules += [_rule("listen", "ingress", _LISTENING, [_EVERYTHING])]
    subjects, policies = [], []
    for speaker in roster.speakers:
        trusted = speaker.name in common_names
        if speaker.name != me and not trusted:
            continue
        rules.append(_rule(f"say {speaker.name}", "ingress", _SPEAKING, _keys(speaker, roster.speaker(me))))
        subjects.append(_subject(speaker, me, common_names))
    said = [f"say {subject['id']}" for subject in subjects]
    for subject in subjects:
        own = [f"say {subject['id']}"]
        says = said if roster.relay and subject["id"] != me else own
        sends = "send" if subject["id"] == me else "link"
        policies.append({"rules": [sends, "listen", *says], "subjects": [subject["id"]]})
    control = {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects}
    return {"access_control": control | {"policies": policies}}


def _subject(speaker: Speaker, me: str, common_names: Mapping[str, str]) -> dict[str, Any]:
    if speaker.name == me:
        return {"id": me, "link_protocols": [_LOCAL]}
    return {"id": speaker.name, "cert_common_names": [common_names[speaker.name]]}


def _keys(speaker: Speaker, me: Speaker) -> list[str]:
    """Return the keys under which a computer may bring messages to the router of `me`."""
    own = list(_OF_COMPUTERS)
    if speaker.operator or speaker == me:
        own += _OF_OPERATORS
    elif me.operator:
        own.append(OBSTACLES.name)  # who changes the list knows what others keep clear of; it is not adopted by itself
    agents, topics = speaker.senders[1:], _OF_CLIENTS if speaker == me else _OF_AGENTS
    return [f"swarm/*/{speaker.name}/{name}" for name in own] + [
        f"swarm/*/{agent}/{name}" for agent in agents for name in topics
    ]


def _rule(name: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": keys}
