"""What happens on the bus of a simulated row, what is expected there, and protections of it that are switched off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.planning.separation_policy import Guaranteed
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.peers.senders import SenderVerifier
from swarmctl.bus.topics import PATH, Topic
from swarmctl.core.types import Array, PredictedPath
from tests.closed_loop.test_guaranteed_cut_off import only_seen
from tests.faults.row import Off
from tests.faults.simulated import VICTIM, Holds, Scene

OTHERS = (0, 2, 3)
_HZ = 25  # ticks of a coarse scene


def forget_stale(now: PeerPaths, *_: object) -> tuple[PredictedPath, ...]:
    """Return the newest paths without those that are older than 0.2 s, as if who is silent had gone."""
    newest = max((path.t0_utc_us for path in now._newest.values()), default=0)
    return tuple(path for path in now._newest.values() if newest - path.t0_utc_us < 200_000)


FORGETS = Off(patches=((PeerPaths, "latest", forget_stale), (PeerPaths, "near", forget_stale)))
BELIEVES_ALL = Off(patches=((SenderVerifier, "_refusal", lambda *_: ""),))
NOT_WAITED_FOR = Off(patches=((Coordination, "_required_peers", only_seen),))
FLIES_ON = Off(patches=((WorldModel, "has_unresponsive_peer", lambda *_: False),))


def refused(reason: str, count: int, by: Sequence[int] = OTHERS) -> Holds:
    """Return whether each of these agents has refused so many messages for this reason."""
    return lambda scene: all(scene.agent(i).rejected.get(reason, 0) >= count for i in by)


def commits_nothing(agents: Sequence[int], from_s: float, to_s: float) -> dict[str, Holds]:
    """Return the claim that these agents, who miss an answer, commit to nothing new in a time after the event."""

    def holds(scene: Scene) -> bool:
        policies = [scene.agent(i)._separation for i in agents]
        committed = sum(p._coordination.counts.committed for p in policies if isinstance(p, Guaranteed))
        if scene.since_s <= from_s:
            scene.notes["committed"] = committed
        return not from_s < scene.since_s <= to_s or committed == scene.notes["committed"]

    return {"agents commit without an answer": holds}


def rests(agents: Sequence[int], slower_m_s: float = 0.25) -> Holds:
    return lambda scene: all(scene.speed_m_s(i) < slower_m_s for i in agents)


def wait(agents: Sequence[int]) -> Holds:
    return lambda scene: all(scene.waits(i) for i in agents)


def arrived(scene: Scene) -> bool:
    return scene.all_arrived()


def for_(seconds: float, begin: Callable[[Scene], None], end: Callable[[Scene], None]) -> Callable[[Scene], None]:
    """Return an event that begins and, after so long, ends."""

    def happens(scene: Scene) -> None:
        begin(scene)

        def later(running: Scene) -> None:
            if running.since_s >= seconds and "ended" not in running.notes:
                running.notes["ended"] = True
                end(running)

        scene.each_tick.append(later)

    return happens


def bus_fails(seconds: float) -> Callable[[Scene], None]:
    return for_(seconds, lambda scene: scene.lockstep.hub.fail(), lambda scene: scene.lockstep.hub.recover())


def cut(pairs: Sequence[tuple[int, int]], seconds: float) -> Callable[[Scene], None]:
    """Return an event that stops what each first one sends to the second."""

    def switch(scene: Scene, how: str) -> None:
        for sender, receiver in pairs:
            getattr(scene.lockstep.hub, how)(agent_name(sender), agent_name(receiver))

    return for_(seconds, lambda scene: switch(scene, "cut"), lambda scene: switch(scene, "mend"))


def between(one: Sequence[int], other: Sequence[int]) -> list[tuple[int, int]]:
    """Return both directions of the link of two hosts, by their agents."""
    return [pair for a in one for b in other for pair in ((a, b), (b, a))]


def overhears(change: Callable[[Scene, str, Topic, bytes], Sequence[tuple[str, bytes]]]) -> Callable[[Scene], None]:
    """Return an event after which each path of the victim is accompanied by others: of these names, these bytes."""

    def happens(scene: Scene) -> None:
        hub = scene.lockstep.hub
        carry = hub.carry

        def carried(sender: str, topic: Topic, payload: bytes, *only: Any) -> None:
            carry(sender, topic, payload, *only)
            if sender == agent_name(VICTIM) and topic is PATH:
                for name, more in change(scene, sender, topic, payload):
                    carry(name, topic, more)

        hub.carry = carried  # type: ignore[method-assign, assignment]
        for i in scene.agents:
            count_offers(scene, i)

    return happens


def count_offers(scene: Scene, agent: int) -> None:
    paths = scene.agent(agent)._world_model.paths
    offer = paths.offer

    def counted(*received: Any) -> None:
        scene.notes["offers", agent] += 1
        offer(*received)

    scene.notes["offers", agent] = 0
    paths.offer = counted  # type: ignore[method-assign, assignment]


def changed(payload: bytes, **fields: Any) -> bytes:
    path = decode_path(payload)
    assert path is not None
    return encode_path(replace(path, **fields))


def away(payload: bytes) -> Array:
    path = decode_path(payload)
    assert path is not None
    return np.asarray(path.pos_ned_m + np.array([40.0, 0.0, 0.0]))


def malformed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return the same path cut short, of no numbers, of another version, and too long."""
    path = decode_path(payload)
    assert path is not None
    nowhere = encode_path(replace(path, seq=path.seq + 1, pos_ned_m=np.full_like(path.pos_ned_m, np.nan)))
    return [(sender, bytes(spoilt)) for spoilt in (payload[:-1], nowhere, b"XP" + payload[2:], payload * 60)]


def replayed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    kept: list[bytes] = scene.notes.setdefault("kept", [])
    kept.append(payload)
    return [(sender, kept[-_HZ])] if len(kept) > _HZ else []


def misnamed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return a path of the victim, elsewhere, as another agent sends it under its own key."""
    path = decode_path(payload)
    assert path is not None
    return [(agent_name(2), changed(payload, seq=path.seq + 1, pos_ned_m=away(payload)))]


def of_the_future(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    path = decode_path(payload)
    assert path is not None
    later_us = path.t0_utc_us + 1_500_000
    return [(sender, changed(payload, seq=path.seq + 1, t0_utc_us=later_us, pos_ned_m=away(payload)))]


def of_the_past(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    path = decode_path(payload)
    assert path is not None
    earlier_us = path.t0_utc_us - 2_500_000
    return [(sender, changed(payload, seq=path.seq + 1, t0_utc_us=earlier_us, pos_ned_m=away(payload)))]


def copied(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    return [(sender, payload)] * (2000 // _HZ - 1)


def counted_up(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return paths as new as the true one, each of the next number: a peer that runs away with its counter."""
    number: int = scene.notes.get("number", 0)
    path = decode_path(payload)
    assert path is not None
    first = max(number, path.seq) + 1
    scene.notes["number"] = first + 2000 // _HZ
    return [(sender, changed(payload, seq=first + k)) for k in range(2000 // _HZ)]


def least_work(scene: Scene) -> bool:
    """Return whether no agent looks at more than its ring of messages of a sender in a tick."""
    counts = [scene.notes["offers", i] for i in scene.agents]
    scene.notes |= {("offers", i): 0 for i in scene.agents}
    return bool(max(counts) <= PATH.ring * (len(counts) - 1))


def whoever(paths: PeerPaths, sender: str, path: PredictedPath, utc_us: int) -> str:
    """Refuse only what is in the own name."""
    return "" if path.agent in paths._verifiers else "unknown_peer"


BUSY = {"an agent looks at a flood of messages": least_work}


def excluded(scene: Scene, agent: int) -> list[Any]:
    return [event for event in scene.events(agent, "membership") if event["excluded"] == [VICTIM]]


def others_arrived(scene: Scene) -> bool:
    pos = scene.lockstep.world.truth_rows()["pos_ned_m"]
    goals = -np.array(scene.config.starts_ned_m())
    return all(bool(np.linalg.norm((pos[i] - goals[i])[:2]) < 0.5) for i in OTHERS)


def unchecked(payload: bytes) -> PredictedPath | None:
    """Decode what is long enough, whatever it holds."""
    path = decode_path(payload)
    if path is not None or len(payload) < 100 or len(payload) > 4000:
        return path
    points = np.frombuffer(payload[36 : 36 + 12 * ((len(payload) - 36) // 12)], "<f4").reshape(-1, 3)
    header = np.frombuffer(payload[4:16], "<u4").tolist()
    (t0_utc_us,) = np.frombuffer(payload[16:24], "<i8").tolist()
    return PredictedPath(
        agent=header[0],
        boot_id=header[1],
        seq=header[2],
        t0_utc_us=t0_utc_us,
        dt_us=100_000,
        margin_m=0.0,
        pos_ned_m=points.astype(np.float64),
    )
