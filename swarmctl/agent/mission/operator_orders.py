"""What an operator orders while the swarm flies: obeyed or refused, and answered either way."""

from __future__ import annotations

from dataclasses import replace

from swarmctl.agent.mission.mission_change import MissionChange
from swarmctl.agent.ports import Ports
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.phases.obeyed_orders import outcome_of
from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.core.operator_verbs import BEGIN, CLOCK, EXCLUDE, MISSION, PEER, Order


class OperatorOrders:
    """Has every order obeyed by who it is for: the state machine, or the world model.

    Args:
        setup: parameters and place in the swarm.
        ports: vehicle, bus and time; receives the events `operator`, `order_refused` and `mission_changed`.
        world_model: keeps the answers until they are published.
        state_machine: flies what is ordered.
        alerts: are told of refusals.
    """

    def __init__(
        self,
        setup: AgentSetup,
        ports: Ports,
        world_model: WorldModel,
        state_machine: MissionStateMachine,
        *,
        alerts: Alerts,
    ) -> None:
        self._ports, self._alerts = ports, alerts
        self._world_model, self._state_machine = world_model, state_machine
        self._missions = MissionChange(setup, ports.bus, world_model.refusals)

    def receive_missions(self) -> None:
        """Take in the missions that have arrived; none is flown before it is ordered."""
        self._missions.receive(self._ports.clock.utc_us())

    def ask(self, order: Order, now_us: int) -> str:
        """Obey an order, or return why it is refused; the operator is answered either way."""
        order = self._by_own_clock(order)
        refusal = self._refusal(order, now_us)
        comes_to = "" if refusal else outcome_of(order, self._state_machine.mission)
        self._world_model.answer(order, refusal, comes_to)
        if refusal:
            self._alerts.put("order", f"{order.verb} refused: {refusal}", now_us)
            self._ports.note("order_refused", verb=order.verb, reason=refusal, **order.arguments)
            return refusal
        self._ports.note("operator", verb=order.verb, **order.arguments)
        offered = self._state_machine.mission.offered
        if order.verb == MISSION and offered is not None:
            goal = offered.reference.goal
            pos_ned_m = None if goal is None else goal.pos_ned_m.tolist()
            self._ports.note(
                "mission_changed", duration_s=offered.duration_s, mission=offered.text, goal_ned_m=pos_ned_m
            )
        return ""

    def _by_own_clock(self, order: Order) -> Order:
        """Return the order with its begin by the own clock, where it is by that of an agent: all begin at one time."""
        if CLOCK not in order.arguments:
            return order
        arguments = {name: value for name, value in order.arguments.items() if name != CLOCK}
        arguments[BEGIN] -= 1e-6 * self._world_model.clocks.ahead_us(int(order.arguments[CLOCK]))
        return replace(order, arguments=arguments)

    def _refusal(self, order: Order, now_us: int) -> str:
        """Obey an order; return why it is refused, or ""."""
        if order.verb == EXCLUDE:
            return self._exclude(int(order.arguments[PEER]))
        refusal = self._offer_mission(order, now_us) if order.verb == MISSION else ""
        state, obstacles = self._ports.autopilot.poll(now_us), self._world_model.obstacles.resting
        return refusal or self._state_machine.operator(order, now_us, self._ports.utc_of_us(now_us), state, obstacles)

    def _exclude(self, peer: int) -> str:
        """Believe that a peer has ended; return why not, or ""."""
        life_sign = self._world_model.life_sign(peer, self._ports.clock.utc_us())
        if not life_sign:
            self._world_model.statuses.exclude(peer)
        return life_sign

    def _offer_mission(self, order: Order, now_us: int) -> str:
        """Have the state machine know the mission of an order; return why it is not flown, or ""."""
        ground_z_m, obstacles = self._state_machine.mission.ground_z_m, self._world_model.obstacles.resting
        offered = self._missions.offer(order, self._ports.utc_of_us(now_us), ground_z_m, obstacles)
        if isinstance(offered, str):
            return offered
        self._state_machine.mission.offered = offered
        return ""
