"""Publishes the results of a tick: the record for recorder and viewer, the status for peers and operators."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence

from swarmctl.agent.ports import TickSink
from swarmctl.agent.tick_results import ControlOutput, PlanningResult
from swarmctl.agent.watches.alerts import Alert
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import MAX_REASON, AnswerMessage, StatusMessage, encode_message
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.control.estimation.disturbance import Estimate
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.clock import Clock
from swarmctl.core.operator_verbs import Answer
from swarmctl.core.quantile import quantile
from swarmctl.core.recorded.received import frame_rows, path_row, status_row
from swarmctl.core.recorded.records import pack_tick, tick_row
from swarmctl.core.recorded.tick_record import TickRecord, TickTiming
from swarmctl.core.types import PredictedPath, VehicleState
from swarmctl.mavlink.vehicle.autopilot import Autopilot

_STATUS_EVERY_US = 200_000
_RECENT_TICKS = 250


class TelemetryPublisher:
    """Counts ticks, records them and publishes the agent's status five times a second.

    Args:
        agent, boot_id, sysid: identity in the messages.
        uses_commitments: whether the agent flies only trajectories it has committed to.
        code: that it flies, see `AgentSetup`.
        autopilot: source of the vehicle's reported modes.
        paths: newest paths of peers.
        lags_us: returns what peers have to know to measure clocks, see `StatusMessage`, at a UTC [us].
        bus, clock, sink: where messages go, their stamps, where records go.
    """

    def __init__(
        self,
        agent: int,
        boot_id: int,
        sysid: int,
        uses_commitments: bool,
        *,
        code: str,
        autopilot: Autopilot,
        paths: PeerPaths,
        lags_us: Callable[[int], Mapping[int, int]],
        bus: Bus,
        clock: Clock,
        sink: TickSink,
    ) -> None:
        self._agent, self._boot_id, self._sysid, self._uses_commitments = agent, boot_id, sysid, uses_commitments
        self._code = code
        self._autopilot, self._paths, self._lags_us = autopilot, paths, lags_us
        self._bus, self._clock, self._sink = bus, clock, sink
        self._recent_ms: deque[float] = deque(maxlen=_RECENT_TICKS)
        self._status_us = -_STATUS_EVERY_US
        self.seq = 0
        self.failed_plans = 0
        self.active_alert: Alert | None = None

    def record(
        self,
        now_us: int,
        state: VehicleState | None,
        planning: PlanningResult,
        output: ControlOutput,
        *,
        mission: MissionState,
        estimate: Estimate,
        deadline_misses: int,
        timing: TickTiming,
    ) -> TickRecord:
        """Return the record of one tick; the setpoint has been sent before."""
        self.seq += 1
        utc_us = self._clock.utc_of_us(now_us)
        battery_01 = self._autopilot.health.battery_01
        peers, obstacles, age_ms = self._distances(planning, utc_us - now_us)
        return TickRecord(
            t_us=now_us,
            utc_us=utc_us,
            seq=self.seq,
            mission_t_s=mission.mission_t_s(utc_us),
            phase=mission.phase,
            mode=output.mode,
            control=mission.control_mode(output.mode),
            flight_mode=self._autopilot.mode,
            armed=self._autopilot.armed,
            state=state,
            reference=planning.reference,
            plan=planning.plan,
            flown=output.flown,
            setpoint=output.setpoint,
            setpoint_accel_ned_m_s2=output.setpoint_accel_ned_m_s2,
            hover_thrust_01=estimate.hover_thrust_01,
            disturbance_ned_m_s2=estimate.disturbance_ned_m_s2,
            nearest_peer_m=min(peers, default=math.inf),
            nearest_obstacle_m=min(obstacles, default=math.inf),
            plan_staleness_ms=age_ms,
            peers=len(peers),
            rejected=self._paths.refusals.total,
            deadline_misses=deadline_misses,
            safety_filter_acted=output.safety_filter_acted,
            battery_01=math.nan if battery_01 is None else battery_01,
            timing=timing,
        )

    def publish(
        self,
        record: TickRecord,
        mission: MissionState,
        excused: Collection[int],
        accepted: Sequence[PredictedPath | StatusMessage],
    ) -> None:
        """Hand a record to the sink and the bus, and a status where one is due, with the peers that are excused.

        The sink alone is told what the tick has received, `accepted` messages of peers among it.
        """
        self._recent_ms.append(record.timing.tick_ms)
        row = tick_row(record)
        self._sink.tick(row, record.flown)
        self._sink.received(self._received(record.t_us, accepted))
        self._bus.publish(topics.TICK, pack_tick(row, record.flown))
        if record.t_us - self._status_us >= _STATUS_EVERY_US:
            self._status_us = record.t_us
            self._bus.publish(topics.STATUS, encode_message(self._status(record, mission, excused)))

    def _received(self, t_us: int, accepted: Sequence[PredictedPath | StatusMessage]) -> bytes:
        rows = frame_rows(t_us, self._agent, self._autopilot.arrived_us)
        for told in accepted:
            if isinstance(told, PredictedPath):
                rows.append(path_row(t_us, told))
            else:
                rows.append(status_row(t_us, told.agent, told.ticks, told.utc_us, keeps_up=told.keeps_up))
        return b"".join(rows)

    def answer(self, answer: Answer) -> None:
        """Answer an operator's order."""
        message = AnswerMessage(
            agent=self._agent,
            boot_id=self._boot_id,
            verb=answer.verb,
            number=answer.number,
            accepted=answer.accepted,
            reason=answer.reason[:MAX_REASON],
            utc_us=self._clock.utc_us(),
        )
        self._bus.publish(topics.ANSWER, encode_message(message))

    def _distances(self, planning: PlanningResult, offset_us: int) -> tuple[list[float], list[float], float]:
        """Return distances to peers and visible obstacles [m] when the setpoint acts, and the largest staleness [ms].

        A path begins when its sender's setpoint acts, so its staleness counts from there to when our setpoint acts.
        `offset_us` is UTC minus monotonic time.
        """
        if planning.start is None:
            return [], [], math.nan
        start, act_utc_us = planning.start, planning.start.t_us + offset_us
        here = start.pos_ned_m.tolist()
        peers = [math.dist(here, k.pos_ned_m[0].tolist()) for k in planning.keep_outs if k.priority_id >= 0]
        obstacles = [k.distance_m(start.pos_ned_m) for k in planning.keep_outs if k.priority_id < 0]
        ages_ms = [(act_utc_us - path.t0_utc_us) * 1e-3 for path in self._paths.near()]
        return peers, obstacles, max(ages_ms, default=math.nan)

    def _status(self, record: TickRecord, mission: MissionState, excused: Collection[int]) -> StatusMessage:
        state, reference, error_m = record.state, record.reference, math.nan
        health, received_us, alert = self._autopilot.health, self._autopilot.received_us, self.active_alert
        if state is not None and reference is not None:
            error = state.pos_ned_m - reference.pos_ned_m[0]
            error_m = math.sqrt(float(error @ error))
        return StatusMessage(
            agent=self._agent,
            boot_id=self._boot_id,
            sysid=self._sysid,
            phase=int(record.phase),
            mode=int(record.mode),
            flight_mode=int(record.flight_mode),
            armed=record.armed,
            landed=int(self._autopilot.landed),
            held=mission.held,
            control=record.control.name,
            altitude_m=0.0 if state is None else -float(state.pos_ned_m[2]),
            ground_speed_m_s=-1.0 if state is None else math.hypot(*state.vel_ned_m_s[:2].tolist()),
            battery_01=_known(health.battery_01),
            pos_accuracy_m=_known(self._autopilot.pos_accuracy_m),
            gps_fix=-1 if health.gps_fix is None else health.gps_fix,
            satellites=-1 if health.satellites is None else health.satellites,
            link_age_ms=-1.0 if received_us is None else (record.t_us - received_us) * 1e-3,
            ready_utc_us=mission.ready_utc_us,
            mission_t_s=_finite(record.mission_t_s),
            keeps_up=mission.keeps_up,
            ends_in_s=_finite(mission.ends_in_s(record.t_us, record.utc_us)),
            outcome=mission.outcome,
            position_error_m=_finite(error_m),
            separation_m=_finite(record.nearest_peer_m),
            tick_p99_ms=quantile(self._recent_ms, 0.99),
            ticks=record.seq,
            deadline_misses=record.deadline_misses,
            plan_staleness_ms=_finite(record.plan_staleness_ms),
            solver_failed=self.failed_plans,
            active_alert="" if alert is None else alert.text,
            alert_age_s=-1.0 if alert is None else (record.t_us - alert.since_us) * 1e-6,
            uses_commitments=self._uses_commitments,
            utc_us=record.utc_us,
            without=tuple(sorted(excused)),
            code=self._code,
            lags_us={} if self._uses_commitments else dict(self._lags_us(record.utc_us)),
        )


def _known(value: float | None) -> float:
    """Return the value, or -1 in place of None."""
    return -1.0 if value is None else _finite(value)


def _finite(value: float) -> float:
    """Return the value, or -1 in place of NaN and infinity, which JSON lacks."""
    return value if math.isfinite(value) else -1.0
