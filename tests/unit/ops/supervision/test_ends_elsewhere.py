"""Who is asked about agents of a host that is gone has heard of their ends before."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import msgspec
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import EndedMessage, StatusMessage, encode_message
from swarmctl.bus.network.roster import OwnIdentity, Roster, Speaker
from swarmctl.bus.topics import ENDED, STATUS
from swarmctl.ops.orders.operator import ends_heard
from swarmctl.ops.supervision.bus_report import BusReport
from swarmctl.ops.supervision.ends_elsewhere import EndsElsewhere
from swarmctl.ops.supervision.status_table import PlainLines
from tests.benches.scripted_services import ScriptedServices, ends
from tests.builders import status_message

OTHERS = {"bravo": frozenset({1, 2}), "charlie": frozenset({3})}


class Heard:
    """A host that hears two others, on a scripted clock."""

    def __init__(self) -> None:
        self.now_s, self.refused = 100.0, list[str]()
        hub = LocalHub(lambda: round(self.now_s * 1e6))
        self.hosts = {name: hub.connect(name) for name in OTHERS}
        bus = hub.connect("alpha", {ENDED: [*OTHERS]})
        self._report = BusReport(bus, lambda event, **_: self.refused.append(event), PlainLines(StringIO()))
        self.ends = EndsElsewhere(OTHERS)

    def says(self, host: str, agent: int, boot_id: int | None, *, is_down: bool = True) -> None:
        message = EndedMessage(agent=agent, boot_id=boot_id, is_down=is_down)
        self.hosts[host].publish(ENDED, encode_message(message))

    def down(self, later_s: float) -> tuple[int, ...]:
        self.now_s += later_s
        self.ends.receive(self._report)
        self._report.step()
        return self.ends.down(self.now_s)


def status(agent: int, boot_id: int) -> StatusMessage:
    return msgspec.structs.replace(status_message(agent=agent), boot_id=boot_id)


def identity(name: str) -> OwnIdentity:
    agents = {"alpha": (0,), "bravo": (1,), "station": ()}
    speakers = tuple(
        Speaker(name=each, agents=numbers, senders=(each,), operator=each != "bravo")
        for each, numbers in agents.items()
    )
    return OwnIdentity(folder="", name=name, roster=Roster(speakers=speakers, relay=False))


def test_who_has_ended_down_is_known_for_good_and_nobody_of_whom_only_others_say_so() -> None:
    heard = Heard()
    heard.ends.hear(status(1, 7), heard.now_s)
    heard.says("bravo", 1, 7)
    heard.says("bravo", 2, 8, is_down=False)
    heard.says("charlie", 2, 8)
    assert heard.down(2.9) == (), "its last status is not old yet"
    assert heard.refused == ["refused"], "what another host says"
    assert heard.down(0.2) == (1,)
    assert heard.down(1000.0) == (1,), "its host says nothing more"


def test_who_was_never_heard_and_has_ended_is_down_and_who_was_started_again_is_not() -> None:
    heard = Heard()
    heard.says("charlie", 3, None)
    heard.says("bravo", 1, 7)
    assert heard.down(0.1) == (1, 3)
    heard.ends.hear(status(1, 9), heard.now_s)
    assert heard.down(100.0) == (3,)


def test_a_host_hears_the_ends_of_all_others_and_a_launch_alone_of_none() -> None:
    assert ends_heard(identity("alpha")) == {"bravo": {1}}
    assert ends_heard(identity("station")) == {"alpha": {0}, "bravo": {1}}
    assert ends_heard(None) == {}


@pytest.mark.process
def test_operators_of_a_host_are_told_of_an_end_that_nobody_says_any_more(tmp_path: Path) -> None:
    services = ScriptedServices(tmp_path, [ends(0, 1.0)])
    services.context = replace(services.context, identity=identity("alpha"))
    services.bus = services.hub.connect("alpha", {STATUS: [agent_name(0)], ENDED: ["bravo"]})
    bravo = services.hub.connect("bravo")
    services.act = lambda: bravo.publish(ENDED, encode_message(EndedMessage(agent=1, boot_id=5, is_down=True)))
    services.fly("swarm.agents=2")
    assert services.down == (1,)
