"""Missions that an operator has sent while the swarm flies: kept until one is ordered, and checked before it is flown.

The whole swarm's mission is checked where the order comes from; what is checked here is what keeps this vehicle safe,
within a part of a tick.
"""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError

from swarmctl.agent.setup import AgentSetup
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import decode_mission
from swarmctl.bus.refusals import MALFORMED, Refusals
from swarmctl.control.phases.trajectories import OfferedMission
from swarmctl.control.reference.feasibility import FlightLimits, infeasible
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.obstacle import Obstacle, taken_by
from swarmctl.core.operator_verbs import BEGIN, MISSION, Order

_KEPT = 4  # newest missions
_SAMPLES = 2000  # of the reference: two milliseconds of a tick
_MAX_LEAD_S = 10.0  # between an agent's clock and the begin of a mission
_MAX_DURATION_S = 7200.0


class MissionChange:
    """Holds what an agent needs to fly another mission than that of its configuration.

    Args:
        setup: parameters and place in the swarm.
        bus: connection to the operator.
        refusals: count of messages that were refused.
    """

    def __init__(self, setup: AgentSetup, bus: Bus, refusals: Refusals) -> None:
        self._setup, self._bus, self._refusals = setup, bus, refusals
        self._texts: dict[int, str] = {}  # by number, the newest last

    def receive(self, utc_us: int) -> None:
        """Take in the missions that have arrived; none is flown before it is ordered."""
        for sender, payload in self._bus.receive(topics.MISSION):
            message = decode_mission(payload)
            if message is None:
                self._refusals.add(sender, topics.MISSION.name, MALFORMED, utc_us)
                continue
            self._texts.pop(message.mission, None)
            self._texts[message.mission] = message.text
            for number in list(self._texts)[:-_KEPT]:
                del self._texts[number]

    def offer(
        self, order: Order, utc_us: int, ground_z_m: float | None, obstacles: Mapping[int, Obstacle]
    ) -> OfferedMission | str:
        """Return the mission that is ordered, or why it is not flown.

        Args:
            order: of an operator.
            utc_us: now.
            ground_z_m: down coordinate of the ground, which the operator's side does not know of real vehicles.
            obstacles: those at rest, by number: no mission may end in one.
        """
        text = self._texts.get(int(order.arguments[MISSION]))
        if text is None:
            return "the mission has not arrived; give the order again"
        if abs(order.arguments[BEGIN] - utc_us * 1e-6) > _MAX_LEAD_S:
            return f"the mission would begin more than {_MAX_LEAD_S:g} s from now, by its clock"
        try:
            mission = MissionParams.model_validate_json(text)
        except ValidationError as error:
            return f"its mission has a wrong value: {error.errors()[0]['msg']}"
        offered = self._reference(mission, ground_z_m)
        goal = None if isinstance(offered, str) else offered.reference.goal
        taken = "" if goal is None else taken_by(goal.pos_ned_m, obstacles)
        return f"its goal is in {taken}" if taken else offered

    def _reference(self, mission: MissionParams, ground_z_m: float | None) -> OfferedMission | str:
        setup, agents = self._setup, len(self._setup.starts_ned_m)
        if mission.is_own:
            return "a mission of somebody else's code is flown only by a launch that was started with it"
        if mission.duration_s > _MAX_DURATION_S:
            return f"the mission takes {mission.duration_s:g} s; {_MAX_DURATION_S:g} at most"
        if problems := list(mission.problems(agents)):
            return problems[0]
        budget = setup.separation.budget
        reference = MissionReference(mission, setup.starts_ned_m, setup.agent, budget.planned_m)
        limits = FlightLimits(
            duration_s=mission.duration_s,
            apart_m=0.0,  # whether those of a whole swarm stay apart is checked where the order comes from
            downwash=1.0,
            ground_z_m=ground_z_m,
            ground="the place of the take-off",
            volume=setup.volume,
            fence=setup.fence,
        )
        problems = list(infeasible([reference], [setup.vehicle_model], limits, most_samples=_SAMPLES))
        if problems:
            return problems[0].removeprefix("mission: agent 0: ")
        text = mission.model_dump_json(exclude_defaults=True)
        return OfferedMission(reference=reference, duration_s=mission.duration_s, text=text)
