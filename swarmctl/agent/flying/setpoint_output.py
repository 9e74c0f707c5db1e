"""From the plan that is flown in a tick to the one setpoint that leaves in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from swarmctl.agent.flying.safety_filter import SafetyFilter
from swarmctl.agent.planning.reference_selector import ReferenceSelector
from swarmctl.agent.ports import Ports
from swarmctl.agent.sensing.own_state import OwnState
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.mpc.problem import Start
from swarmctl.control.reference.heading import Heading
from swarmctl.control.setpoint import SetpointHold, holding_height, setpoint_of, within_bounds
from swarmctl.core.frames import euler_from_quat
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.types import Array, AttitudeSetpoint, Plan, VehicleState


class SetpointOutput:
    """Sends the setpoints of one agent.

    Args:
        setup: model of the vehicle, and the heading to begin with.
        ports: the vehicle; receives the event `setpoint_refused`.
        safety_filter: sees every command before it is sent.
        own_state: is told what was sent.
        references: know the heading to turn to.
        alerts: are told of setpoints that are refused.
    """

    def __init__(
        self,
        setup: AgentSetup,
        ports: Ports,
        safety_filter: SafetyFilter,
        own_state: OwnState,
        references: ReferenceSelector,
        *,
        alerts: Alerts,
    ) -> None:
        self._model, self._heading = setup.vehicle_model, Heading(setup.mission.yaw_rad)
        self._thrust_max_m_s2 = setup.controller.mpc.most_thrust_m_s2(self._model)
        self._ports, self._safety_filter, self._own_state = ports, safety_filter, own_state
        self._references, self._alerts = references, alerts
        self._hold = SetpointHold()

    def send(
        self,
        now_us: int,
        flown: Plan | None,
        start: Start | None,
        state: VehicleState | None,
        *,
        flies: bool,
        committed_peers: Mapping[int, Sequence[Trajectory]],
        followed_z_m: float | None,
    ) -> AttitudeSetpoint | None:
        """Send the command of a plan that acts when the setpoint arrives; returns what has been sent.

        Args:
            now_us: monotonic time.
            flown: plan of this tick; None: nothing is sent.
            start: predicted state at which the setpoint acts; None: nothing is sent.
            state: newest one of the vehicle.
            flies: the agent flies the vehicle in this tick's mode.
            committed_peers: trajectories that peers have committed to.
            followed_z_m: down coordinate now of the reference that is followed; None if unknown.
        """
        if flown is None or start is None:
            self._safety_filter.skip(now_us)
            return None
        act_us, estimate = now_us + self._own_state.delay_us, self._own_state.estimate
        middle_us = act_us + self._hold.middle_us(now_us, flown.dt_us)
        step = min(max(0, (middle_us - flown.t0_us) // flown.dt_us), len(flown.virtual_control) - 1)
        virtual_control = self._safety_filter.keep_apart(
            now_us,
            self._ports.utc_of_us(act_us),
            self._holding_height(now_us, flown.virtual_control[step], state, followed_z_m),
            start,
            estimate=estimate,
            flies=flies,
            committed_peers=committed_peers,
        )
        virtual_control = within_bounds(virtual_control, estimate.hover_thrust_01, self._model)
        if not flies and state is not None:
            self._heading.begin(euler_from_quat(state.q_nb)[2])
        yaw_rad = self._heading.at(now_us, self._references.heading_rad(self._ports.utc_of_us(now_us)))
        setpoint = setpoint_of(virtual_control, yaw_rad, estimate.hover_thrust_01, now_us, params=self._model)
        if refused := self._ports.autopilot.send(setpoint, self._ports.clock.now_us()):
            self._alerts.put("setpoint", f"setpoint refused: {refused}", now_us)
            self._ports.note("setpoint_refused", reason=refused)
            return None
        self._own_state.sent(now_us, virtual_control, setpoint.thrust_01)  # what is remembered is what is flown
        return setpoint

    def _holding_height(
        self, now_us: int, virtual_control: Array, state: VehicleState | None, followed_z_m: float | None
    ) -> Array:
        """Return a command (3,) that gives up no more height, and say so where it is not the one asked for."""
        if state is None or followed_z_m is None:
            return virtual_control
        below_m = float(state.pos_ned_m[2]) - followed_z_m
        held = holding_height(virtual_control, below_m, self._thrust_max_m_s2)
        if held is not virtual_control:
            text = f"{below_m:.1f} m too low: tilts no more than its thrust holds, and may be blown away"
            self._alerts.put("height", text, now_us)
        return held
