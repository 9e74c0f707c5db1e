"""Test bench of the mission state machine: drives a `MissionStateMachine` with synthetic inputs."""

from __future__ import annotations

from typing import Any

import numpy as np

from swarmctl.control.failsafe.decision import NOTHING_WORN
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases.inputs import PeerInputs, PhaseInputs
from swarmctl.control.phases.mission_state import MissionSetup
from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import Order
from swarmctl.core.types import Command, FlightMode, Landed, Mode, Phase, VehicleState, Verb
from tests import builders

UTC0_US = 1_700_000_000_000_000
START = np.array([1.0, 0.0, -3.0])
SECOND = 1_000_000
DURATION_S = 10.0
RADIUS_M = 0.9
ON_GROUND, IN_AIR = Landed.ON_GROUND, Landed.IN_AIR


class Flight:
    """One `MissionStateMachine`, its vehicle and its clock; every call of `step` is 100 ms later."""

    def __init__(self, peers: int = 1, **params: Any) -> None:
        mission = MissionReference(MissionParams(kind="line"), START[None, :], 0)
        told = StateMachineParams(**params)
        setup = MissionSetup(
            agent=0,
            peers=peers,
            landing_m=RADIUS_M + told.apart_m,
            home_m=2.0 / 3.0 * RADIUS_M,
            start_ned_m=START,
            brake_m_s2=2.0,
            duration_s=DURATION_S,
            reference=mission,
        )
        self.state_machine = MissionStateMachine(told, setup)
        self.mission = self.state_machine.mission
        self.now_us = 0
        self.pos, self.vel = np.array([1.0, 0.0, 0.0]), np.zeros(3)
        self.armed, self.flight_mode, self.landed = False, FlightMode.HOLD, ON_GROUND
        self.failsafe_mode = Mode.IDLE
        self.prepared = self.armable = True
        self.failsafe = False
        self.others: tuple[np.ndarray, ...] = ()
        self.obstacles: tuple[Obstacle, ...] = ()
        self.arm_in: FlightMode | None = None
        self.boots = 0
        self.refusal = self.unsettled = self.too_slow = self.cut_off = ""
        self.overload, self.missed_01 = Level.NONE, 0.0
        self.beat_us: int | None = None  # arrival of the HEARTBEAT that reported `armed`; None: one with every step
        self.busy = self.unresponsive_peer = False
        self.setpoints_stopped = ""
        self.seen = True
        self.escalation = NOTHING_WORN
        self.excused: frozenset[int] = frozenset()
        self.peers = {k + 1: PeerInputs(Phase.STANDBY, 0, True) for k in range(peers)}

    @property
    def utc_us(self) -> int:
        return UTC0_US + self.now_us

    @property
    def phase(self) -> Phase:
        return self.mission.phase

    @property
    def at(self) -> str:
        """Return the name of the phase."""
        return self.phase.name

    @property
    def state(self) -> VehicleState | None:
        if not self.seen:
            return None
        q_nb = np.array([1.0, 0.0, 0.0, 0.0])
        return builders.vehicle_state(
            t_us=self.now_us,
            pos_ned_m=self.pos,
            vel_ned_m_s=self.vel,
            q_nb=q_nb,
            armed=self.armed,
            mode=self.flight_mode,
            landed=self.landed,
            failsafe=self.failsafe,
        )

    def step(self) -> list[Command]:
        inputs = PhaseInputs(
            setpoints_stopped=self.setpoints_stopped,
            now_us=self.now_us,
            utc_us=self.utc_us,
            state=self.state,
            prepared=self.prepared,
            armable=self.armable,
            busy=self.busy,
            mode=self.failsafe_mode,
            unresponsive_peer=self.unresponsive_peer,
            peers=lambda: self.peers,
            excused=self.excused,
            others_ned_m=lambda: self.others,
            obstacles=lambda _: [o for o in self.obstacles if not o.moves],
            moving_obstacles=lambda: [o for o in self.obstacles if o.moves],
            arm_in=self.arm_in,
            boots=self.boots,
            refusal=self.refusal,
            unsettled=self.unsettled,
            too_slow=self.too_slow,
            missed_01=self.missed_01,
            overload=self.overload,
            cut_off=self.cut_off,
            escalation=self.escalation,
            armed_told_us=self.now_us if self.beat_us is None else self.beat_us,
        )
        self.state_machine.begin_if_due(inputs.now_us, inputs.utc_us, inputs.state)  # before planning
        asked = self.state_machine.step(inputs)
        self.now_us += 100_000
        return asked

    def run(self, seconds: float) -> list[Verb]:
        return [command.verb for _ in range(round(seconds * 10)) for command in self.step()]

    def peer(self, phase: Phase, ready_utc_us: int = 0, alive: bool = True) -> None:
        self.peers[1] = PeerInputs(phase, ready_utc_us, alive)

    def ask(self, verb: str, **arguments: float) -> str:
        """Give an operator's order; return why it is refused, or ""."""
        obstacles = dict(enumerate(self.obstacles))
        return self.state_machine.operator(Order(verb, arguments), self.now_us, self.utc_us, self.state, obstacles)

    def until(self, phase: Phase) -> Flight:
        """Continue without faults until a phase is reached."""
        for _ in range(400):
            if self.phase is phase:
                return self
            self._obey(self.step())
        raise AssertionError(f"stuck in {self.phase.name}")

    def _obey(self, commands: list[Command]) -> None:
        for command in commands:
            if command.verb in (Verb.ARM, Verb.DISARM):
                self.armed = command.verb is Verb.ARM
            elif command.verb is Verb.TAKEOFF:
                self.pos, self.landed, self.flight_mode = START.copy(), IN_AIR, FlightMode.HOLD
            elif command.verb is Verb.EXTERNAL:
                self.flight_mode = FlightMode.EXTERNAL
            elif command.verb is Verb.LAND:
                self.flight_mode = FlightMode.LAND
        if self.phase is Phase.READY and len(self.peers) == 1:
            self.peer(Phase.READY, UTC0_US + 1)
        if self.phase is Phase.LAND and self.flight_mode is FlightMode.LAND:
            self.armed, self.landed = False, ON_GROUND


def verbs(commands: list[Command]) -> list[Verb]:
    return [command.verb for command in commands]


def ready(peers: int = 1) -> Flight:
    flight = Flight(peers).until(Phase.GOTO_START)
    while flight.phase is not Phase.READY:
        flight._obey(flight.step()) if flight.flight_mode is not FlightMode.EXTERNAL else flight.step()
    return flight


CONTROLLED_PHASES = (Phase.GOTO_START, Phase.READY, Phase.TRACK, Phase.GOTO_LAND)


def in_phase(phase: Phase) -> Flight:
    """Return a flight in any phase, under the agent's control where that phase has it."""
    if phase in CONTROLLED_PHASES:
        return controlled(phase)
    if phase < Phase.GOTO_START:
        flight = Flight().until(phase)
        if phase is Phase.TAKEOFF:
            flight.pos, flight.landed = START + np.array([0.0, 0.0, 1.5]), IN_AIR  # half way up
            flight.flight_mode = FlightMode.TAKEOFF
        return flight
    flight = controlled(Phase.GOTO_LAND)
    flight.pos = START.copy()
    return flight.until(phase)


def controlled(phase: Phase) -> Flight:
    flight = ready() if phase in (Phase.READY, Phase.TRACK, Phase.GOTO_LAND) else Flight().until(Phase.GOTO_START)
    if phase is Phase.GOTO_START:
        flight.flight_mode, flight.pos = FlightMode.EXTERNAL, START + np.array([3.0, 0.0, 0.0])
        flight.run(0.2)
    elif phase is not Phase.READY:
        flight.until(Phase.TRACK)
    if phase is Phase.GOTO_LAND:
        flight.pos = START + np.array([3.0, 0.0, 0.0])
        flight.until(phase)
    assert flight.phase is phase
    assert flight.mission.had_control
    return flight
