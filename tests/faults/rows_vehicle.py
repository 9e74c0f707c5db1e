"""The link to a vehicle, its estimate, its autopilot, its pilot, and the vehicle itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.agent.sharing.path_publisher import PathPublisher
from swarmctl.control.estimation import accuracy
from swarmctl.control.failsafe import decision
from swarmctl.control.phases import handover
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.control.phases.state_machine import REBOOTED
from swarmctl.core.types import Mode, Phase
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.vehicle.local_frame import LocalFrame
from swarmctl.mavlink.vehicle.state_samples import StateSamples
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock
from tests.closed_loop.conftest import COARSE
from tests.faults.row import Off
from tests.faults.rows_agents import lands
from tests.faults.simulated import AIR, ALONE, GUARANTEED, SWAP, VICTIM, Scene, SimulatedRow, tracking

STALE_FLOWN = Off(settings=("agent.failsafe.state_max_age_s=5",))
ALWAYS_OURS = Off(  # neither the failsafe's table nor the state machine looks at who flies
    patches=(
        (
            decision,
            "_TABLE",
            tuple(row for row in decision._TABLE if row[0].__name__ not in ("_taken_over", "_overridden")),
        ),
        (handover, "is_under_other_control", lambda state: False),
        (MissionState, "override", lambda *_: None),
    )
)


def link(
    kind: str, value: float, *, vehicle: int = VICTIM, for_s: float = 0.0, **fields: Any
) -> Callable[[Scene], None]:
    return lambda scene: scene.fault(kind, vehicle, value=value, for_s=for_s, **fields)


def several(*events: Callable[[Scene], None]) -> Callable[[Scene], None]:
    def happens(scene: Scene) -> None:
        for event in events:
            event(scene)

    return happens


def nothing_is_sent(scene: Scene, agent: int = VICTIM) -> bool:
    return bool(scene.tick(agent)["setpoint_thrust_01"] != scene.tick(agent)["setpoint_thrust_01"])  # NaN


def overridden(scene: Scene) -> bool:
    return Mode.PILOT_OVERRIDE in scene.modes[VICTIM] and nothing_is_sent(scene)


def pilot(command: int, *params: float) -> Callable[[Scene], None]:
    """Return an event: a ground station sends a command to the victim's vehicle."""
    filled = (*params, *(0.0,) * (7 - len(params)))
    message = mavlink.MAVLink_command_long_message(VICTIM + 1, 1, command, 0, *filled)
    return lambda scene: scene.lockstep.links[VICTIM][0].send(Codec(255, 190).encode(message))


def parameter(name: str, value: float) -> Callable[[Scene], None]:
    message = mavlink.MAVLink_param_set_message(VICTIM + 1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)
    return lambda scene: scene.lockstep.links[VICTIM][0].send(Codec(255, 190).encode(message))


def tracks(scene: Scene) -> bool:
    return scene.phase(VICTIM) is Phase.TRACK and int(scene.tick(VICTIM)["mode"]) == Mode.TRACKING


SET_MODE, ARM_DISARM = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_COMPONENT_ARM_DISARM
BY_FORCE = 21196.0


def _unchecked(codec: Codec, frame: bytes) -> bytes | None:
    """Return what a frame holds, whether its checksum is right or not."""
    message_id = int.from_bytes(frame[7:10], "little")
    if len(frame) < 12 or message_id not in mavlink.mavlink_map:
        return None
    size = mavlink.mavlink_map[message_id].unpacker.size
    return bytes(frame[10 : 10 + frame[1]]).ljust(size, b"\0")[:size]


def _as_it_comes(self: StateSamples, vehicle_us: int, arrived_us: int, *values: Any, **more: Any) -> bool:
    """Take a state for as new as its arrival."""
    return _TAKE(self, arrived_us, arrived_us, *values, **more)


_TAKE = StateSamples._take
FROM_THE_GROUND = (*COARSE, "swarm.agents=2", "start.spacing_m=4", "mission.kind=line", "mission.duration_s=60")
HOVER_BESIDE = (  # the drifting estimate takes the first towards the second
    *COARSE,
    AIR,
    "swarm.agents=2",
    "mission.kind=hover",
    "mission.duration_s=15",
    "start.positions_ned_m=[[0,0,-2],[-1.2,0,-2]]",
)
MOBILE = (*SWAP, "sitl.battery.capacity_mah=3000", "agent.failsafe.window_s=1")

ROWS = (
    SimulatedRow(
        name="state-late",
        event="the states of a vehicle are lost for 0.4 s",
        reaction="nothing is sent from states older than 0.2 s; then the mission goes on",
        within_s=0.3,
        protection="limit on the age of the own state (agent.failsafe.state_max_age_s)",
        happens=link("link_loss", 1.0, for_s=0.4, direction="from_vehicle"),
        reacts=lambda scene: Mode.STATE_STALE in scene.modes[VICTIM] and nothing_is_sent(scene),
        lasts_s=3.0,
        finally_={"it does not track again": tracks},
        off=STALE_FLOWN,
    ),
    SimulatedRow(
        name="state-lost",
        event="the states of a vehicle are lost for good",
        reaction="nothing is sent, its autopilot lands it, the others keep clear",
        within_s=1.2,
        protection="limit on the age of the own state (agent.failsafe.state_max_age_s)",
        happens=link("link_loss", 1.0, direction="from_vehicle"),
        reacts=lands,
        lasts_s=5.0,
        always={},
        off=STALE_FLOWN,
    ),
    SimulatedRow(
        name="setpoints-lost",
        event="nothing reaches a vehicle any more, which is heard",
        reaction="its autopilot lands it; the agent yields, the others keep clear",
        within_s=1.2,
        protection="offboard-loss action of the autopilot",
        happens=link("link_loss", 1.0, direction="to_vehicle"),
        reacts=lambda scene: lands(scene) and overridden(scene),
        lasts_s=5.0,
        off=Off(settings=("agent.autopilot_params={COM_OBL_RC_ACT=4,COM_OF_LOSS_T=60}",)),
    ),
    SimulatedRow(
        name="link-lost-3s",
        event="the link of a vehicle is dead for 3 s, and comes back",
        reaction="its autopilot lands it; the agent does not take it back",
        within_s=1.2,
        protection="who flies is looked at before anything is sent",
        happens=link("link_loss", 1.0, for_s=3.0),
        reacts=lands,
        lasts_s=6.0,
        finally_={"the agent sends": nothing_is_sent},
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="link-lost-3s-arducopter",
        event="the link of an ArduCopter, which lands 2 s later and flies straight on until then, is dead for 3 s",
        reaction="its agent tells where it flies without it, the others keep clear",
        within_s=2.5,
        protection="path of a vehicle that hears nothing",
        config="ardupilot_sitl.toml",
        due=tracking(2.0),
        happens=link("link_loss", 1.0, for_s=3.0),
        reacts=lands,
        lasts_s=6.0,
        finally_={"the agent sends": nothing_is_sent},
        off=Off(patches=((PathPublisher, "_coasts", lambda *_: False),)),
    ),
    SimulatedRow(
        name="link-bad",
        event="a tenth of all MAVLink datagrams is lost, all late by up to 200 ms, a fifth twice, two fifths overtaken",
        reaction="nobody comes too close; the vehicle stays under control, or lands",
        within_s=8.0,
        protection="the vehicle's own stamps order its states, and tell their age",
        happens=several(
            link("link_loss", 0.1),
            link("link_jitter", 200.0),
            link("link_duplicate", 0.2),
            link("link_reorder", 0.4),
        ),
        reacts=lambda scene: scene.since_s > 7.5,
        lasts_s=8.0,
        off=Off(patches=((StateSamples, "_take", _as_it_comes),)),
    ),
    SimulatedRow(
        name="link-corrupt",
        event="in a third of all MAVLink datagrams a bit is turned",
        reaction="damaged frames are dropped, the mission goes on",
        within_s=6.0,
        protection="checksums of frames",
        happens=link("link_corrupt", 0.33),
        reacts=lambda scene: scene.since_s > 5.5 and tracks(scene),
        lasts_s=6.0,
        off=Off(patches=((Codec, "payload", _unchecked),)),
    ),
    SimulatedRow(
        name="estimate-jumps",
        event="the estimate of a vehicle jumps by 3 m",
        reaction="it is told, the vehicle flies on from where it was, the others keep that much more away",
        within_s=0.3,
        protection="jumps are bridged",
        scene=ALONE,
        happens=lambda scene: scene.fault("estimator_jump", 0, value=3.0, towards_deg=90.0),
        reacts=lambda scene: bool(scene.events(0, "estimate_jumped")),
        lasts_s=4.0,
        always={"it races across the difference": lambda scene: scene.speed_m_s(0) < 3.5},
        off=Off(patches=((LocalFrame, "_fit", lambda *_, **__: None),)),
    ),
    SimulatedRow(
        name="autopilot-reboots-in-flight",
        event="an autopilot reboots in flight",
        reaction="its vehicle is not armed again, the others keep clear, the mission says why it failed",
        within_s=12.0,
        protection="reboots are noticed",
        scene=ALONE,
        happens=lambda scene: scene.lockstep.world.reboot(0, scene.lockstep.clock.now_us()),
        reacts=lambda scene: scene.agent(0).outcome == REBOOTED,
        lasts_s=12.5,
        fastest_m_s=100.0,
        off=Off(patches=((VehicleClock, "boots", property(lambda self: 0, lambda self, count: None)),)),
    ),
    SimulatedRow(
        name="pilot-takes-over",
        event="a pilot switches a vehicle to HOLD",
        reaction="the agent yields and never takes it back",
        within_s=0.3,
        protection="who flies is looked at before anything is sent",
        happens=pilot(SET_MODE, 1.0, 4.0, 3.0),
        reacts=overridden,
        lasts_s=4.0,
        finally_={"the agent sends": nothing_is_sent},
        apart_m=0.75,
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="pilot-takes-over-guaranteed",
        event="likewise with guaranteed separation",
        reaction="the agent yields and never takes it back; the others keep clear",
        within_s=0.3,
        protection="who flies is looked at before anything is sent",
        scene=GUARANTEED,
        happens=pilot(SET_MODE, 1.0, 4.0, 3.0),
        reacts=overridden,
        lasts_s=4.0,
        finally_={"the agent sends": nothing_is_sent},
        apart_m=0.75,
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="pilot-lands",
        event="a pilot lands a vehicle",
        reaction="the agent yields and never takes it back",
        within_s=0.3,
        protection="who flies is looked at before anything is sent",
        happens=pilot(SET_MODE, 1.0, 4.0, 6.0),
        reacts=lambda scene: overridden(scene) and lands(scene),
        lasts_s=4.0,
        finally_={"the agent sends": nothing_is_sent},
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="pilot-kills",
        event="a pilot disarms a vehicle in the air, by force",
        reaction="it is not armed again; the others keep clear",
        within_s=0.5,
        protection="who flies is looked at before anything is sent",
        happens=pilot(ARM_DISARM, 0.0, BY_FORCE),
        reacts=lambda scene: not scene.true(VICTIM)["armed"] and nothing_is_sent(scene),
        lasts_s=3.0,
        fastest_m_s=60.0,
        finally_={"the agent sends": nothing_is_sent},
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="geofence",
        event="a vehicle breaks its autopilot's geofence, which holds it",
        reaction="the agent yields and never takes it back",
        within_s=2.5,
        protection="who flies is looked at before anything is sent",
        scene=FROM_THE_GROUND,
        happens=parameter("GF_MAX_HOR_DIST", 1.0),
        reacts=overridden,
        lasts_s=5.0,
        finally_={"the agent sends": nothing_is_sent},
        off=ALWAYS_OURS,
    ),
    SimulatedRow(
        name="gps-lost",
        event="one of four in a swap loses GPS, and its autopilot goes on by dead reckoning",
        reaction="it brakes and lands while it still knows where it is; the others keep clear",
        within_s=6.0,
        protection="escalation by the time without GPS (agent.failsafe.dead_reckoning_land_s)",
        happens=link("gps_loss", 0.0),
        reacts=lambda scene: any(e["response"] == "LAND" for e in scene.events(VICTIM, "escalation")) and lands(scene),
        lasts_s=12.0,
        off=Off(settings=("agent.failsafe.dead_reckoning_land_s=60",)),
    ),
    SimulatedRow(
        name="gps-lost-beside",
        event="one of two that hover 1.2 m apart loses GPS, and drifts towards the other, before it lands",
        reaction="the other makes room",
        within_s=4.0,
        protection="distance that peers keep for the accuracy that is lost (AccuracyLoss)",
        scene=HOVER_BESIDE,
        due=lambda scene: scene.mission_s >= 2.0,
        happens=link("gps_loss", 0.0, vehicle=0),
        reacts=lambda scene: scene.true(1)["pos_ned_m"][0] < -1.5,
        lasts_s=6.0,
        off=Off(patches=((accuracy, "_SIGMAS", 0.0),)),
    ),
    SimulatedRow(
        name="battery-low",
        event="the charge of a vehicle is down to 15 %",
        reaction="its agent flies it back to its start, under its own plan",
        within_s=2.0,
        protection="escalation by charge (agent.failsafe.battery_rtl_01)",
        scene=MOBILE,
        happens=link("battery", 0.15),
        reacts=lambda scene: scene.phase(VICTIM) is Phase.GOTO_LAND,
        lasts_s=6.0,
        off=Off(settings=("agent.failsafe.battery_rtl_01=0", "agent.failsafe.battery_land_01=0")),
    ),
    SimulatedRow(
        name="battery-empty",
        event="the charge of a vehicle is down to 8 %",
        reaction="its agent lands it where it is, after making room",
        within_s=4.0,
        protection="escalation by charge (agent.failsafe.battery_land_01)",
        scene=MOBILE,
        happens=link("battery", 0.08),
        reacts=lambda scene: any(e["response"] == "LAND" for e in scene.events(VICTIM, "escalation")),
        lasts_s=6.0,
        off=Off(settings=("agent.failsafe.battery_rtl_01=0", "agent.failsafe.battery_land_01=0")),
    ),
)
