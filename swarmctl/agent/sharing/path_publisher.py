"""Publishes the agent's own predicted path, with the margin that peers have to keep beside it."""

from __future__ import annotations

import math
from collections.abc import Iterable

from swarmctl.agent.ports import Ports
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.sharing.far_paths import FarPaths
from swarmctl.agent.sharing.path_sharing import PathSharing
from swarmctl.bus import topics
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.estimation.flown_by_others import (
    STEERED_MARGIN_M,
    StopJudge,
    is_steered,
    predict_after_setpoints,
    predict_flown_by_others,
    predict_without_setpoints,
)
from swarmctl.control.estimation.gust import GustWatch
from swarmctl.core.autopilot_stop import ANSWER_S, BRAKE_M_S2
from swarmctl.core.ordered_sums import ordered_sum
from swarmctl.core.trajectory import grid
from swarmctl.core.types import MAX_MARGIN_M, Array, FlightMode, Plan, PredictedPath, VehicleState

_DOUBT_US = 600_000  # ahead, over which two ways of a vehicle are compared: they part by metres, and are told anew
_COMMITTED_EVERY_US = 60_000  # peers compare such paths while they are newer than 0.3 s: one in five suffices
_TOLD_M = 0.3  # by which peers may misplace it when it rests, because they do not know its last setpoint
_BRAKING_S = 0.5  # in which it moves on at the speed that it has when its autopilot brakes, about


class PathPublisher:
    """Tells peers where the vehicle will be: along its plan, or as somebody else flies it.

    While its state is stale nobody hears of it but by its path. In best effort a link that was lost for 3 s amid a swap
    of ArduCopters made bodies touch, as long as peers expected the vehicle to brake at the end of its last path: an
    autopilot that hears nothing flies on first.

    Args:
        setup: identity and parameters.
        ports: bus and clock.
        controller: its plans have the grid of the paths.
        delay_us: from sending a setpoint to when it acts.
        widens_in_gusts: peers keep more while the wind changes; commitments have tubes instead.
    """

    def __init__(
        self, setup: AgentSetup, ports: Ports, controller: Controller, delay_us: int, *, widens_in_gusts: bool
    ) -> None:
        self._setup, self._ports, self._delay_us = setup, ports, delay_us
        self._dt_us, self._steps, self._widens_in_gusts = controller.dt_us, controller.steps, widens_in_gusts
        self._max_age_us = round(setup.params.failsafe.state_max_age_s * 1e6)
        self._sharing = PathSharing(setup.params.path_sharing, setup.separation)
        self._lag_s, self._drag_1_s = setup.vehicle_model.lag_s, setup.vehicle_model.drag_1_s
        self._gust, self._stop_judge = GustWatch(), StopJudge()
        self._published_us, self._margin_m = -_COMMITTED_EVERY_US, 0.0
        self._told_accel_ned_m_s2: Array | None = None
        self._flown: tuple[Plan, int] | None = None  # newest plan that was flown, and when its last setpoint acts
        self._far = FarPaths(setup.params.path_sharing)

    def publish(
        self,
        now_us: int,
        state: VehicleState | None,
        flown: Plan | None,
        seq: int,
        *,
        setpoint_accel_ned_m_s2: Array | None,
        disturbance_ned_m_s2: Array,
        margins_m: Iterable[float],
        as_committed: bool,
    ) -> None:
        """Publish the path of this tick, if peers need it and it is known where the vehicle is.

        Args:
            now_us: monotonic time of the tick.
            state: newest state.
            flown: plan that is flown, None when the autopilot flies.
            seq: number of the tick.
            setpoint_accel_ned_m_s2: (3,) that the setpoint of this tick asks for; None if none has left.
            disturbance_ned_m_s2: (3,) estimate.
            margins_m: what peers have to keep more, for each reason there is besides gusts.
            as_committed: peers know what is flown from what has been committed to, and compare it with the path.
        """
        if flown is None or not self._widens_in_gusts:
            self._gust.forget()
        else:
            self._gust.update(now_us, disturbance_ned_m_s2)
        if state is None or (flown is None and not (self._is_recent(now_us, state) or self._coasts(now_us, state))):
            return
        margin_m = ordered_sum((*margins_m, self._gust.margin_m))
        is_known = as_committed and flown is not None and margin_m == self._margin_m
        is_known = is_known and self._is_as_told(setpoint_accel_ned_m_s2)
        if is_known and now_us - self._published_us < _COMMITTED_EVERY_US:
            return
        self._published_us, self._margin_m, self._told_accel_ned_m_s2 = now_us, margin_m, setpoint_accel_ned_m_s2
        path = self._path(now_us, state, flown, seq, margin_m, setpoint_accel_ned_m_s2)
        for_all = self._far.include(path, now_us)
        message = self._sharing.message(path, for_all=for_all)
        if message is not None:
            self._ports.bus.publish(topics.FAR_PATH if for_all else topics.PATH, message)

    def _is_as_told(self, accel_ned_m_s2: Array | None) -> bool:
        """Return whether peers know what the setpoint asks for, should it be the last one that the vehicle gets."""
        told, autopilot = self._told_accel_ned_m_s2, self._ports.autopilot
        keeps_s, coasts_s = autopilot.setpoint_loss_s, autopilot.landing_delay_s
        if accel_ned_m_s2 is None and told is None:
            return True
        if accel_ned_m_s2 is None or told is None or keeps_s is None or coasts_s is None:
            return False
        moves_s2 = keeps_s * (coasts_s - 0.5 * keeps_s + _BRAKING_S)  # m for each m/s2 that is kept
        return math.dist(accel_ned_m_s2.tolist(), told.tolist()) * moves_s2 <= _TOLD_M

    @property
    def told_m_s(self) -> float:
        """Speed that the vehicle keeps to, as those out of reach have been told."""
        return self._far.told_m_s

    def _is_recent(self, now_us: int, state: VehicleState) -> bool:
        """Return whether a state may be continued: peers could not tell that a path from it is older than it says."""
        return now_us - state.t_us <= self._max_age_us

    def _coasts(self, now_us: int, state: VehicleState) -> bool:
        """Return whether a vehicle of which nothing is heard still flies on as its autopilot does without a link."""
        coasts_s = self._ports.autopilot.landing_delay_s
        if coasts_s is None or self._ports.autopilot.setpoint_loss_s is None or state.mode is not FlightMode.EXTERNAL:
            return False
        brakes_s = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s)) / BRAKE_M_S2 + ANSWER_S
        return now_us - state.t_us <= (coasts_s + brakes_s) * 1e6

    def _path(
        self,
        now_us: int,
        state: VehicleState,
        flown: Plan | None,
        seq: int,
        margin_m: float,
        accel_ned_m_s2: Array | None,
    ) -> PredictedPath:
        if flown is not None:
            self._stop_judge.forget()
            self._flown = flown, now_us + self._delay_us
            t0_us, dt_us, pos = flown.t0_us, flown.dt_us, flown.pos_ned_m
            unheard_since_us = self._ports.autopilot.unheard_since_us(now_us)
            if unheard_since_us is not None:
                pos, apart_m = self._unheard(state, flown, unheard_since_us)
                margin_m += apart_m
                accel_ned_m_s2 = None  # of a setpoint that may not have arrived
        else:
            t0_us, dt_us = now_us + self._delay_us, self._dt_us
            if self._is_recent(now_us, state):
                stops, ahead_s = self._stop_judge.update(state), self._ahead_s(t0_us, state.t_us)
                brake_m_s2 = self._setup.separation.brake_m_s2
                pos = predict_flown_by_others(state, ahead_s, brake_m_s2, stops=stops, drag_1_s=self._drag_1_s)
                margin_m += 0.0 if stops or not is_steered(state) else STEERED_MARGIN_M
            else:
                pos, apart_m = self._without_link(state, t0_us)
                age_s = (now_us - state.t_us) * 1e-6  # as much as peers keep from a path of this age:
                margin_m += apart_m + self._setup.separation.budget.age_margin_m(age_s, parked=False)
        return PredictedPath(
            agent=self._setup.agent,
            boot_id=self._setup.boot_id,
            seq=seq,
            t0_utc_us=self._ports.utc_of_us(t0_us),
            dt_us=dt_us,
            margin_m=min(MAX_MARGIN_M, margin_m),
            pos_ned_m=pos,
            setpoint_accel_ned_m_s2=None if flown is None else accel_ned_m_s2,
        )

    def _without_link(self, state: VehicleState, t0_us: int) -> tuple[Array, float]:
        """Return positions (N, 3), NED [m], from `t0_us` on of a vehicle that `_coasts`, and how far it may be off [m].

        It keeps the attitude of the last setpoint that it has heard. In which direction the link has failed is not
        known: that may be the one of its last state, or the last one that was sent. The middle of both ways is
        returned, and what is between them while the attitude is kept.
        """
        keeps_s, coasts_s = self._ports.autopilot.setpoint_loss_s, self._ports.autopilot.landing_delay_s
        assert keeps_s is not None and coasts_s is not None
        brake_m_s2, drag_1_s = self._setup.separation.brake_m_s2, self._drag_1_s
        limits = {"keeps_s": keeps_s, "coasts_s": coasts_s, "brake_m_s2": brake_m_s2, "drag_1_s": drag_1_s}
        deaf = predict_without_setpoints(state, self._ahead_s(t0_us, state.t_us), **limits)
        if self._flown is None or self._flown[1] <= state.t_us:
            return deaf, 0.0
        plan, last_us = self._flown
        heard = predict_after_setpoints(plan, last_us, self._ahead_s(t0_us, last_us), lag_s=self._lag_s, **limits)
        return _middle(heard, deaf, self._dt_us)

    def _unheard(self, state: VehicleState, flown: Plan, unheard_since_us: int) -> tuple[Array, float]:
        """Return positions (N, 3), NED [m], of a vehicle that misses setpoints, and how far it may be off [m].

        It keeps its attitude until it hears one or its autopilot takes over. The middle between that way and the plan
        is returned, and what is between them while the attitude is kept.
        """
        keeps_s, coasts_s = self._ports.autopilot.setpoint_loss_s, self._ports.autopilot.landing_delay_s
        if keeps_s is None or coasts_s is None:
            return flown.pos_ned_m, 0.0
        kept_s = (state.t_us - unheard_since_us) * 1e-6
        ahead_s = grid(len(flown.pos_ned_m) - 1) * (flown.dt_us * 1e-6) + (flown.t0_us - state.t_us) * 1e-6
        deaf = predict_without_setpoints(
            state,
            ahead_s,
            keeps_s=max(0.0, keeps_s - kept_s),
            coasts_s=max(0.0, coasts_s - kept_s),
            brake_m_s2=self._setup.separation.brake_m_s2,
            drag_1_s=self._drag_1_s,
        )
        return _middle(flown.pos_ned_m, deaf, flown.dt_us)

    def _ahead_s(self, t0_us: int, since_us: int) -> Array:
        """Return the times (N,) [s] of a path from `t0_us` on, counted from another time."""
        return grid(self._steps) * (self._dt_us * 1e-6) + (t0_us - since_us) * 1e-6


def _middle(one_ned_m: Array, other_ned_m: Array, dt_us: int) -> tuple[Array, float]:
    """Return the middle of two ways, (N, 3) each, that a vehicle may take, and how far off it either is soon [m]."""
    half = 0.5 * (one_ned_m - other_ned_m)
    soon = half[: 1 + round(_DOUBT_US / dt_us)]
    return other_ned_m + half, math.sqrt(float((soon * soon).sum(axis=1).max()))
