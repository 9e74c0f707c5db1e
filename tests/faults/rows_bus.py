"""A peer is silent, late, replayed, malformed, too loud or not who it says; the bus fails, whole or in parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from swarmctl.agent import coordination, world_model
from swarmctl.agent.coordination import Coordination
from swarmctl.agent.separation_policy import Guaranteed
from swarmctl.agent.world_model import WorldModel
from swarmctl.bus import peers
from swarmctl.bus.path_messages import decode_path, encode_path
from swarmctl.bus.peers import PeerPaths, agent_name
from swarmctl.bus.senders import SenderVerifier
from swarmctl.bus.topics import PATH, Topic
from swarmctl.core.types import Array, PredictedPath
from tests.closed_loop.test_guaranteed import only_seen
from tests.faults.row import Off
from tests.faults.simulated import GUARANTEED, VICTIM, Holds, Scene, SimulatedRow, tracking

OTHERS = (0, 2, 3)
_HZ = 25  # ticks of a coarse scene


def forget_stale(now: PeerPaths) -> tuple[PredictedPath, ...]:
    """Return the newest paths without those that are older than 0.2 s, as if who is silent had gone."""
    newest = max((path.t0_utc_us for path in now._sorted), default=0)
    return tuple(path for path in now._sorted if newest - path.t0_utc_us < 200_000)


FORGETS = Off(patches=((PeerPaths, "latest", forget_stale),))
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
        committed = sum(p.coordination.counts.committed for p in policies if isinstance(p, Guaranteed))
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
            _count_offers(scene, i)

    return happens


def _count_offers(scene: Scene, agent: int) -> None:
    paths = scene.agent(agent)._world_model.paths
    offer = paths.offer

    def counted(*received: Any) -> None:
        scene.notes["offers", agent] += 1
        offer(*received)

    scene.notes["offers", agent] = 0
    paths.offer = counted  # type: ignore[method-assign, assignment]


def _changed(payload: bytes, **fields: Any) -> bytes:
    path = decode_path(payload)
    assert path is not None
    return encode_path(replace(path, **fields))


def _away(payload: bytes) -> Array:
    path = decode_path(payload)
    assert path is not None
    return np.asarray(path.pos_ned_m + np.array([40.0, 0.0, 0.0]))


def _malformed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return the same path cut short, of no numbers, of another version, and too long."""
    path = decode_path(payload)
    assert path is not None
    nowhere = encode_path(replace(path, seq=path.seq + 1, pos_ned_m=np.full_like(path.pos_ned_m, np.nan)))
    return [(sender, bytes(spoilt)) for spoilt in (payload[:-1], nowhere, b"XP" + payload[2:], payload * 60)]


def _replayed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    kept: list[bytes] = scene.notes.setdefault("kept", [])
    kept.append(payload)
    return [(sender, kept[-_HZ])] if len(kept) > _HZ else []


def _misnamed(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return a path of the victim, elsewhere, as another agent sends it under its own key."""
    path = decode_path(payload)
    assert path is not None
    return [(agent_name(2), _changed(payload, seq=path.seq + 1, pos_ned_m=_away(payload)))]


def _of_the_future(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    path = decode_path(payload)
    assert path is not None
    later_us = path.t0_utc_us + 1_500_000
    return [(sender, _changed(payload, seq=path.seq + 1, t0_utc_us=later_us, pos_ned_m=_away(payload)))]


def _of_the_past(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    path = decode_path(payload)
    assert path is not None
    earlier_us = path.t0_utc_us - 2_500_000
    return [(sender, _changed(payload, seq=path.seq + 1, t0_utc_us=earlier_us, pos_ned_m=_away(payload)))]


def _copied(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    return [(sender, payload)] * (2000 // _HZ - 1)


def _counted_up(scene: Scene, sender: str, topic: Topic, payload: bytes) -> list[tuple[str, bytes]]:
    """Return paths as new as the true one, each of the next number: a peer that runs away with its counter."""
    number: int = scene.notes.get("number", 0)
    path = decode_path(payload)
    assert path is not None
    first = max(number, path.seq) + 1
    scene.notes["number"] = first + 2000 // _HZ
    return [(sender, _changed(payload, seq=first + k)) for k in range(2000 // _HZ)]


def _least_work(scene: Scene) -> bool:
    """Return whether no agent looks at more than its ring of messages of a sender in a tick."""
    counts = [scene.notes["offers", i] for i in scene.agents]
    scene.notes |= {("offers", i): 0 for i in scene.agents}
    return bool(max(counts) <= PATH.ring * (len(counts) - 1))


def _whoever(paths: PeerPaths, sender: str, path: PredictedPath, utc_us: int) -> str:
    """Refuse only what is in the own name."""
    return "" if path.agent in paths._verifiers else "unknown_peer"


BUSY = {"an agent looks at a flood of messages": _least_work}

ROWS = (
    SimulatedRow(
        name="peer-silent",
        event="the paths of one of four agents reach nobody any more, who goes on flying",
        reaction="all wait, keep clear of where it may be, and name it",
        within_s=1.0,
        protection="rest while a peer is silent that may fly on",
        happens=cut([(VICTIM, i) for i in OTHERS], 60.0),
        reacts=wait(OTHERS),
        lasts_s=5.0,
        finally_={
            "nobody names it": lambda scene: bool(scene.events(0, "unresponsive")),
            "they don't wait": wait(OTHERS),
        },
        off=FLIES_ON,
    ),
    SimulatedRow(
        name="peer-malformed",
        event="an agent's paths arrive with broken copies: cut short, not finite, another version, 60 times as long",
        reaction="the broken ones are counted, the flight is what it was",
        within_s=1.0,
        protection="checks of what a path holds",
        happens=overhears(_malformed),
        reacts=refused("malformed", 20),
        lasts_s=4.0,
        told=(r"agent-1 were refused \(path malformed \d+\)",),
        finally_={"they don't pass": lambda scene: scene.speed_m_s(0) > 0.2},
        off=Off(patches=((peers, "decode_path", lambda payload: _unchecked(payload)),)),
    ),
    SimulatedRow(
        name="peer-replayed",
        event="each path of an agent is followed by its path of a second before",
        reaction="replayed ones are counted and change nothing",
        within_s=1.5,
        protection="numbers of messages",
        due=tracking(0.3),
        happens=overhears(_replayed),
        reacts=refused("replayed", 5),
        lasts_s=4.5,
        off=BELIEVES_ALL,
    ),
    SimulatedRow(
        name="peer-misnamed",
        event="an agent sends, under its own key, paths in the name of another",
        reaction="they are refused, counted and told",
        within_s=1.0,
        protection="the name in a message must be that of its key",
        happens=overhears(_misnamed),
        reacts=refused("identity", 10, (0, 3)),
        lasts_s=4.0,
        told=(r"agent-2 were refused \(path identity \d+\)",),
        off=Off(patches=((PeerPaths, "_refusal", _whoever),)),
    ),
    SimulatedRow(
        name="peer-of-the-future",
        event="an agent's paths arrive with others stamped 1.5 s ahead, which lead away",
        reaction="they are refused, counted and told",
        within_s=1.0,
        protection="limit on how far ahead a path may be stamped",
        happens=overhears(_of_the_future),
        reacts=refused("future", 10),
        lasts_s=4.0,
        told=(r"agent-1 were refused \(path future \d+\)",),
        off=Off(patches=((PeerPaths, "_refusal", lambda *_: ""),)),
    ),
    SimulatedRow(
        name="peer-of-the-past",
        event="an agent's paths arrive with others stamped 2.5 s ago, which lead away",
        reaction="they are refused and counted",
        within_s=1.0,
        protection="limit on the age of a path",
        happens=overhears(_of_the_past),
        reacts=refused("late", 10),
        lasts_s=4.0,
        off=Off(patches=((PeerPaths, "_refusal", lambda *_: ""),)),
    ),
    SimulatedRow(
        name="peer-2khz-copies",
        event="one peer sends each path so often that there are 2000 a second",
        reaction="copies are counted; an agent looks at a few of them in a tick",
        within_s=1.0,
        protection="rings of a few messages for each sender",
        happens=overhears(_copied),
        reacts=refused("replayed", 20),
        lasts_s=4.0,
        always=BUSY,
        off=Off(patches=((peers, "_trim", lambda *_: None),)),
    ),
    SimulatedRow(
        name="peer-2khz-numbers",
        event="one peer sends 2000 paths a second, each of the next number",
        reaction="numbers beyond its rate are refused and told; nobody comes too close",
        within_s=2.0,
        protection="rings of a few messages for each sender",
        happens=overhears(_counted_up),
        reacts=refused("sequence", 10),
        lasts_s=4.0,
        told=(r"agent-1 were refused",),
        always=BUSY,
        off=Off(patches=((peers, "_trim", lambda *_: None),)),
    ),
    SimulatedRow(
        name="bus-silent-10s",
        event="the bus carries nothing for 10 s",
        reaction="all come to rest, and arrive once it does again",
        within_s=2.5,
        protection="rest while a peer is silent that may fly on",
        happens=bus_fails(10.0),
        reacts=rests(range(4)),
        lasts_s=20.0,
        finally_={"they don't arrive": arrived},
        off=Off(patches=((world_model, "_BUS_LOST_US", 10**12),)),
    ),
    SimulatedRow(
        name="bus-silent-10s-guaranteed",
        event="the bus carries nothing for 10 s, with guaranteed separation",
        reaction="all come to rest, and arrive once it does again",
        within_s=7.0,
        protection="who is silent is waited for",
        scene=GUARANTEED,
        happens=bus_fails(10.0),
        reacts=rests(range(4)),
        lasts_s=20.0,
        finally_={"they don't arrive": arrived},
        off=NOT_WAITED_FOR,
    ),
    SimulatedRow(
        name="router-restarts",
        event="the router is gone for 1 s amid the meeting, with guaranteed separation",
        reaction="the swarm goes on, and arrives",
        within_s=12.0,
        protection="who is silent is waited for",
        scene=GUARANTEED,
        due=tracking(2.0),
        happens=bus_fails(1.0),
        reacts=arrived,
        lasts_s=12.5,
        always=commits_nothing(range(4), 0.3, 1.0),
        off=Off(patches=((Coordination, "_required_peers", lambda *_: frozenset()),)),
    ),
    *(
        SimulatedRow(
            name=f"link-cut-{a}-{b}",
            event=f"the link of hosts {a} and {b} is cut for 5 s (three hosts of 1, 2 and 1 agents), and healed",
            reaction="agents that miss each other's answers wait; all arrive",
            within_s=16.0,
            protection="who is silent is waited for",
            scene=GUARANTEED,
            happens=cut(between(one, other), 5.0),
            reacts=arrived,
            lasts_s=16.5,
            always=commits_nothing((*one, *other), 1.0, 5.0),
            off=Off(patches=((Coordination, "_required_peers", lambda *_: frozenset()),)),
        )
        for a, b, one, other in (
            ("alpha", "bravo", (0,), (1, 2)),
            ("bravo", "charlie", (1, 2), (3,)),
            ("alpha", "charlie", (0,), (3,)),
        )
    ),
    SimulatedRow(
        name="cut-one-way",
        event="one agent hears another no longer, which still hears it, for 4 s",
        reaction="it waits; all arrive when it is mended",
        within_s=1.0,
        protection="rest while a peer is silent that may fly on",
        happens=cut([(VICTIM, 0)], 4.0),
        reacts=wait((0,)),
        lasts_s=14.0,
        finally_={"they don't arrive": arrived},
        off=FLIES_ON,
    ),
    SimulatedRow(
        name="cut-one-way-guaranteed",
        event="one agent hears another no longer, which still hears it, for 4 s, with guaranteed separation",
        reaction="it waits, and all arrive",
        within_s=16.0,
        protection="who is silent is waited for",
        scene=GUARANTEED,
        happens=cut([(VICTIM, 0)], 4.0),
        reacts=arrived,
        lasts_s=16.5,
        always=commits_nothing((0,), 1.0, 4.0),
        off=Off(patches=((Coordination, "_required_peers", lambda *_: frozenset()),)),
    ),
    SimulatedRow(
        name="isolated-2.5s",
        event="one host of four is cut off from all others for 2.5 s, with guaranteed separation",
        reaction="it comes to rest; all arrive once it is heard again",
        within_s=4.0,
        protection="who is silent is waited for",
        scene=GUARANTEED,
        happens=cut(between((VICTIM,), OTHERS), 2.5),
        reacts=rests((VICTIM,)),
        always=commits_nothing(range(4), 1.0, 2.5),
        lasts_s=18.0,
        finally_={"they don't arrive": arrived},
        off=Off(patches=((Coordination, "_required_peers", lambda *_: frozenset()),)),
    ),
    SimulatedRow(
        name="isolated-for-good",
        event="one host of four is cut off from all others for good, with guaranteed separation",
        reaction="the majority excludes it and arrives",
        within_s=22.0,
        protection="exclusion by a majority",
        scene=GUARANTEED,
        happens=cut(between((VICTIM,), OTHERS), 600.0),
        reacts=lambda scene: all(bool(_excluded(scene, i)) for i in OTHERS) and _others_arrived(scene),
        lasts_s=22.5,
        finally_={"it does not rest": rests((VICTIM,))},
        off=Off(patches=((coordination, "_SUSPECT_US", 10**12),)),
    ),
)


def _excluded(scene: Scene, agent: int) -> list[Any]:
    return [event for event in scene.events(agent, "membership") if event["excluded"] == [VICTIM]]


def _others_arrived(scene: Scene) -> bool:
    pos = scene.lockstep.world.truth_rows()["pos_ned_m"]
    goals = -np.array(scene.config.starts_ned_m())
    return all(bool(np.linalg.norm((pos[i] - goals[i])[:2]) < 0.5) for i in OTHERS)


def _unchecked(payload: bytes) -> PredictedPath | None:
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
