"""Parameters that matter for flying by setpoints, with the wanted value and the reason: one table per autopilot.

Wanted values come from, in this order, `agent.autopilot_params`, the rules of the dialect, and these tables. `--apply`
changes only those with a value `to_set`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from swarmctl.check.finding import Finding, Verdict
from swarmctl.check.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.types import Landed
from swarmctl.mavlink.dialects import DIALECTS, Dialect, Rule

Number = float | int
RC_RECEIVER = 1 << 16  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER
_OFFBOARD_EXCEPTED = 4  # COM_RCL_EXCEPT bit 2
_STICKS_NOT_BY_RADIO = (1, 4)  # COM_RC_IN_MODE: joystick only, disabled
_HOVER_APART_01 = 0.1
_GUIDED_SILENCE_S = 1.0
_LAND_WITHOUT_STATION = 5  # FS_GCS_ENABLE
_FENCE_ACTIONS = (2, 5)  # GF_ACTION
_WEIGHT_WANTED, _WEIGHT_TABLE = 60, 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Opinion:
    """An assessment of one value of one parameter."""

    verdict: Verdict
    wanted: str
    advice: str = ""
    to_set: Number | None = None


_Judge = Callable[[float, VehicleFacts, Config], Opinion]


@dataclass(frozen=True, slots=True)
class Row:
    """One parameter and the rule that assesses its value."""

    name: str
    why: str  # why it matters
    judge: _Judge


def _ok(wanted: str) -> Opinion:
    return Opinion(verdict=Verdict.OK, wanted=wanted)


# --- PX4 ---


def _offboard_loss(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value in (4, 5):
        return _ok("4 land, 5 hold")
    meet = "the way home is not kept clear of the others"
    return Opinion(
        verdict=Verdict.NOTE,
        wanted="4 land, 5 hold",
        advice=f"when setpoints stop the vehicle returns, and {meet}; 4 lands",
    )


def _offboard_timeout(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    wanted = "0.2 to 1.0 s"
    if value > 1.0:
        why = "for that long the last attitude is flown when setpoints stop"
        return Opinion(verdict=Verdict.FIX, wanted=wanted, advice=f"{why}; set 1.0", to_set=1.0)
    if value < 0.2:
        return Opinion(
            verdict=Verdict.FIX, wanted=wanted, advice="a few late setpoints would end offboard; set 0.5", to_set=0.5
        )
    return _ok(wanted)


def _forward_setpoints(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value == 1:
        return _ok("1")
    return Opinion(verdict=Verdict.FIX, wanted="1", advice="setpoints over MAVLink are not flown; set 1", to_set=1)


def _radio_exception(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    source = facts.number("COM_RC_IN_MODE")
    if source is None or source in _STICKS_NOT_BY_RADIO:
        return _ok("any, no radio is expected")
    if facts.sensors is not None and facts.sensors.present & facts.sensors.healthy & RC_RECEIVER:
        return _ok("any, the radio is there")
    if int(value) & _OFFBOARD_EXCEPTED:
        return _ok("bit 2, offboard")
    action = facts.number("NAV_RCL_ACT")
    told = "" if action is None else f" (NAV_RCL_ACT = {action:g})"
    return Opinion(
        verdict=Verdict.FIX,
        wanted="bit 2, offboard",
        advice=f"a radio is expected (COM_RC_IN_MODE = {source:g}) and none is there: its loss ends offboard{told}; "
        "switch it on, or except offboard",
        to_set=int(value) | _OFFBOARD_EXCEPTED,
    )


def _radio_source(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    return _ok("as the pilot flies; 4 without any")


def _thrust_model(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value == 0 and facts.version is not None and facts.version.has_usb:  # simulators have no such circuit
        return Opinion(
            verdict=Verdict.NOTE,
            wanted="0.2 to 0.5",
            advice="thrust is taken as linear, real propellers are not: calibrate it to hover well",
        )
    return _ok("0 simulated, 0.2 to 0.5 real")


def _hover(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    ours = config.vehicle_model.hover_thrust_01
    wanted = f"vehicle_model.hover_thrust_01 = {ours:g}"
    if abs(value - ours) <= _HOVER_APART_01:
        return _ok(wanted)
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"first guesses differ; set vehicle_model.hover_thrust_01 = {value:g}",
    )


def _fence_action(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value in _FENCE_ACTIONS:
        return _ok("2 hold, 5 land")
    advice = "at the fence it would warn only, return through the others, or stop its motors; set 2"
    return Opinion(verdict=Verdict.FIX, wanted="2 hold, 5 land", advice=advice, to_set=2)


def _own_sysid(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value == facts.sysid:
        return _ok(f"{facts.wanted_sysid}")
    return Opinion(
        verdict=Verdict.FIX,
        wanted=f"{facts.wanted_sysid}",
        advice="it still speaks as another one; reboot the autopilot",
    )


# --- ArduCopter ---


def _guided_options(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if int(value) & 8:
        return _ok("bit 3, thrust as thrust")
    advice = "thrust would be flown as a climb rate; set bit 3"
    return Opinion(verdict=Verdict.FIX, wanted="bit 3, thrust as thrust", advice=advice, to_set=int(value) | 8)


def _guided_timeout(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    wanted = f"at most {_GUIDED_SILENCE_S:g} s"
    if 0 < value <= _GUIDED_SILENCE_S:
        return _ok(wanted)
    why = "for that long the last attitude is flown when setpoints stop"
    return Opinion(
        verdict=Verdict.NOTE, wanted=wanted, advice=f"{why}; set {_GUIDED_SILENCE_S:g}", to_set=_GUIDED_SILENCE_S
    )


def _ground_station_failsafe(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value == _LAND_WITHOUT_STATION:
        return _ok("5, land")
    return Opinion(
        verdict=Verdict.FIX,
        wanted="5, land",
        advice="without its agent it would drift on for ever",
        to_set=_LAND_WITHOUT_STATION,
    )


def _throttle_failsafe(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    radio = facts.sensors is not None and bool(facts.sensors.present & facts.sensors.healthy & RC_RECEIVER)
    if value == 0 or radio:
        return _ok("0, or a radio")
    return Opinion(
        verdict=Verdict.NOTE,
        wanted="0, or a radio",
        advice="no radio is seen: arming is refused, or its loss ends GUIDED",
    )


def _ekf_failsafe(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value in (1, 3):
        return _ok("1 or 3, land")
    return Opinion(
        verdict=Verdict.NOTE, wanted="1 or 3, land", advice="a diverging estimator does not land the vehicle"
    )


def _arming_check(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    if value != 0:
        return _ok("1, all")
    return Opinion(verdict=Verdict.NOTE, wanted="1, all", advice="nothing is checked before arming")


def _angle_max(value: float, facts: VehicleFacts, config: Config) -> Opinion:
    least = math.degrees(config.vehicle_model.tilt_max_rad) * 100
    wanted = f"at least {least:.0f} (vehicle_model.tilt_max_rad)"
    if value >= least - 1:
        return _ok(wanted)
    lower = math.floor(math.radians(value / 100) * 100) / 100
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"the autopilot clips; set vehicle_model.tilt_max_rad = {lower:g} or raise it",
    )


ROWS: dict[str, tuple[Row, ...]] = {
    "PX4": (
        Row("COM_OBL_RC_ACT", "what happens when setpoints stop", _offboard_loss),
        Row("COM_OF_LOSS_T", "how long the last attitude is flown when setpoints stop", _offboard_timeout),
        Row("MAV_FWDEXTSP", "whether setpoints are flown", _forward_setpoints),
        Row("COM_RCL_EXCEPT", "whether a lost radio ends offboard", _radio_exception),
        Row("COM_RC_IN_MODE", "where sticks come from", _radio_source),
        Row("MPC_THR_HOVER", "what hovers", _hover),
        Row("THR_MDL_FAC", "how thrust becomes motor speed", _thrust_model),
        Row("MAV_SYS_ID", "its system id after the next boot", _own_sysid),
    ),
    "ArduCopter": (
        Row("GUID_OPTIONS", "what thrust means", _guided_options),
        Row("GUID_TIMEOUT", "how long the last attitude is flown when setpoints stop", _guided_timeout),
        Row("FS_GCS_ENABLE", "what happens when the agent's heartbeats stop", _ground_station_failsafe),
        Row("FS_THR_ENABLE", "whether a lost radio ends GUIDED", _throttle_failsafe),
        Row("FS_EKF_ACTION", "what happens when the estimator diverges", _ekf_failsafe),
        Row("ARMING_CHECK", "what is checked before arming", _arming_check),
        Row("ANGLE_MAX", "how far it tilts", _angle_max),
        Row("MOT_THST_HOVER", "what hovers", _hover),
        Row("SYSID_THISMAV", "its system id after the next boot", _own_sysid),
    ),
}
_FENCE_ROWS = {"PX4": (Row("GF_ACTION", "what happens at the geofence", _fence_action),)}
_ALSO_READ = {"PX4": ("NAV_RCL_ACT",), "ArduCopter": ()}  # parameters that rows refer to


def names_to_read(dialect: Dialect, config: Config) -> tuple[str, ...]:
    """Return the names of the parameters to read from an autopilot."""
    rows = (row.name for row in _rows(dialect.name, config))
    names = (*config.agent.autopilot_params, *dialect.to_read(), *rows, *_ALSO_READ[dialect.name])
    return tuple(dict.fromkeys(names))


def _rows(autopilot: str, config: Config) -> tuple[Row, ...]:
    return (*ROWS[autopilot], *(_FENCE_ROWS.get(autopilot, ()) if config.geofence.corners_ne_m else ()))


def parameter_findings(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Return one finding per wanted or assessed parameter; none for an unsupported autopilot."""
    return [_finding(facts, name, opinion) for name, opinion in _opinions(facts, config).items()]


def unchangeable(facts: VehicleFacts) -> str:
    """Return why no parameter of this vehicle may be changed now, or ""."""
    if not facts.reached:
        return "it is not reached"
    if facts.sysid != facts.wanted_sysid:
        return f"it is vehicle {facts.sysid}, not {facts.wanted_sysid}"
    if facts.armed:
        return "it is armed"
    if facts.landed not in (Landed.ON_GROUND, Landed.UNKNOWN):
        return "it is in the air"
    return ""


def changes(facts: VehicleFacts, config: Config) -> dict[str, Number]:
    """Return the parameters that `--apply` sets on this vehicle."""
    return {
        name: opinion.to_set
        for name, opinion in _opinions(facts, config).items()
        if opinion.to_set is not None and opinion.verdict is not Verdict.OK and facts.number(name) is not None
    }


def _opinions(facts: VehicleFacts, config: Config) -> dict[str, Opinion]:
    dialect = DIALECTS.get(facts.autopilot_number)
    if dialect is None or facts.parameters is None:
        return {}
    rules = {rule.name: rule for rule in dialect.rules}
    rows = {row.name: row for row in _rows(dialect.name, config)}
    wanted = config.agent.autopilot_params
    return {
        name: _opinion(name, facts, config, rules.get(name), rows.get(name)) for name in {**wanted, **rules, **rows}
    }


def _opinion(name: str, facts: VehicleFacts, config: Config, rule: Rule | None, row: Row | None) -> Opinion:
    value = facts.number(name)
    if name in config.agent.autopilot_params:
        return _as_configured(name, facts, config, rule)
    if value is not None and name in DIALECTS[facts.autopilot_number].given:
        return _ok("set by the agent for its flight")
    if value is None:
        if rule is not None:
            return Opinion(verdict=Verdict.FIX, wanted="readable", advice=rule.problem(None))
        return Opinion(verdict=Verdict.NOTE, wanted="", advice="this autopilot does not tell it: not judged")
    judged = None if row is None else row.judge(value, facts, config)
    broken = "" if rule is None else rule.problem(value)
    if judged is None:
        return Opinion(verdict=Verdict.FIX, wanted="", advice=broken) if broken else _ok("")
    return replace(judged, verdict=Verdict.FIX, advice=broken) if broken else judged


def _as_configured(name: str, facts: VehicleFacts, config: Config, rule: Rule | None) -> Opinion:
    value, want = facts.number(name), config.agent.autopilot_params[name]
    wanted = f"{want:g} (agent.autopilot_params)"
    broken = "" if rule is None else rule.problem(want)
    if broken:
        return Opinion(verdict=Verdict.FIX, wanted=wanted, advice=f"the configuration asks for it: {broken}")
    if value is None:
        advice = f"this autopilot has no such parameter; remove agent.autopilot_params.{name}"
        return Opinion(verdict=Verdict.NOTE if rule is None else Verdict.FIX, wanted=wanted, advice=advice)
    if math.isclose(value, want, rel_tol=1e-6, abs_tol=1e-9):
        return _ok(wanted)
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"the agent sets it for its flight; --apply sets {want:g} for good",
        to_set=want,
    )


def _finding(facts: VehicleFacts, name: str, opinion: Opinion) -> Finding:
    value = facts.number(name)
    weight = _WEIGHT_WANTED if "autopilot_params" in opinion.wanted else _WEIGHT_TABLE
    found = "not told" if value is None else f"{value:g}"
    rows = (*ROWS[facts.autopilot], *_FENCE_ROWS.get(facts.autopilot, ()))
    why = next((row.why for row in rows if row.name == name), "")
    wanted = ": ".join(filter(None, (opinion.wanted, why)))
    return Finding(
        agent=facts.agent,
        topic=name,
        verdict=opinion.verdict,
        found=found,
        wanted=wanted,
        advice=opinion.advice,
        weight=weight,
    )
