"""Parameters that matter for flying by setpoints: what is wanted of each, why, and what `--apply` changes.

Wanted values come from, in this order, `agent.autopilot_params`, and the rules and checks of the autopilot's dialect.
`--apply` changes only those with a value `to_set`.
"""

from __future__ import annotations

import math
from dataclasses import replace

from swarmctl.check.finding import Finding
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.config import Config
from swarmctl.core.mavlink_values import RC_RECEIVER
from swarmctl.core.types import Landed
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.dialect import Dialect, Rule
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.dialects.parameter_check import Opinion, ParameterCheck, ParameterContext, ok

Number = float | int
_WEIGHT_WANTED, _WEIGHT_TABLE = 60, 50


def names_to_read(dialect: Dialect, config: Config) -> tuple[str, ...]:
    """Return the names of the parameters to read from an autopilot."""
    names = (*config.agent.autopilot_params, *dialect.to_read(), *_checks(dialect, config), *dialect.also_read)
    return tuple(dict.fromkeys(names))


def _checks(dialect: Dialect, config: Config) -> dict[str, ParameterCheck]:
    """Return the checks that a configuration needs, by parameter."""
    checks = (*dialect.checks, *(dialect.fence_checks if config.geofence.corners_ne_m else ()))
    return {check.name: check for check in checks}


def parameter_findings(facts: VehicleFacts, config: Config) -> list[Finding]:
    """Return one finding per wanted or assessed parameter; none for an unsupported autopilot or kind of vehicle."""
    dialect = DIALECTS.get(facts.autopilot_number)
    checks = _checks(dialect, config) if dialect is not None else {}
    return [
        _finding(facts, name, opinion, checks[name].why if name in checks else "")
        for name, opinion in _opinions(facts, config).items()
    ]


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
    if dialect is None or facts.parameters is None or facts.kind_problem:
        return {}
    rules = {rule.name: rule for rule in dialect.rules}
    checks = _checks(dialect, config)
    wanted, seen = config.agent.autopilot_params, _context(facts, config)

    def opinion(name: str) -> Opinion:
        value = facts.number(name)
        if name in wanted:
            return _as_configured(name, facts, config, rules.get(name))
        if value is not None and name in dialect.given:
            return ok("set by the agent for its flight")
        return _opinion(value, seen, rules.get(name), checks.get(name))

    return {name: opinion(name) for name in {**wanted, **rules, **checks}}


def _context(facts: VehicleFacts, config: Config) -> ParameterContext:
    """Return what the checks of a dialect may depend on."""
    sensors, version, model = facts.sensors, facts.version, config.model_of(facts.agent)
    return ParameterContext(
        number=facts.number,
        has_radio=sensors is not None and bool(sensors.present & sensors.healthy & RC_RECEIVER),
        is_board=version is not None and version.has_usb,  # simulators have no such circuit
        sysid=facts.sysid,
        wanted_sysid=facts.wanted_sysid,
        hover_thrust_01=model.hover_thrust_01,
        tilt_max_rad=model.tilt_max_rad,
        model_key=config.model_key(facts.agent),
    )


def _opinion(value: float | None, seen: ParameterContext, rule: Rule | None, check: ParameterCheck | None) -> Opinion:
    if value is None:
        if rule is not None:
            return Opinion(verdict=Verdict.FIX, wanted="readable", advice=rule.problem(None))
        return Opinion(verdict=Verdict.NOTE, wanted="", advice="this autopilot does not tell it: not judged")
    judged = None if check is None else check.assess(value, seen)
    broken = "" if rule is None else rule.problem(value)
    if judged is None:
        return Opinion(verdict=Verdict.FIX, wanted="", advice=broken) if broken else ok("")
    return replace(judged, verdict=Verdict.FIX, advice=broken) if broken else judged


def _as_configured(name: str, facts: VehicleFacts, config: Config, rule: Rule | None) -> Opinion:
    value, want = facts.number(name), config.agent.autopilot_params[name]
    wanted = f"{want:g} (agent.autopilot_params)"
    broken = "" if rule is None else rule.problem(want)
    if broken:
        return Opinion(verdict=Verdict.FIX, wanted=wanted, advice=f"the configuration asks for it: {broken}")
    if value is None:
        others = "" if config.swarm.agents == 1 else ", unless it is for other vehicles"
        remove = f"this autopilot has no such parameter: remove agent.autopilot_params.{name}{others}"
        told = (facts.parameters or {}).get(name)  # ArduCopters say nothing of parameters that they don't have
        is_known = told is not None and told.refused
        advice = remove if is_known else f"not answered: look at the loss of the link, unless {remove}"
        return Opinion(verdict=Verdict.NOTE if rule is None else Verdict.FIX, wanted=wanted, advice=advice)
    if math.isclose(value, want, rel_tol=1e-6, abs_tol=1e-9):
        return ok(wanted)
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"the agent sets it for its flight; --apply sets {want:g} for good",
        to_set=want,
    )


def _finding(facts: VehicleFacts, name: str, opinion: Opinion, why: str) -> Finding:
    value = facts.number(name)
    weight = _WEIGHT_WANTED if "autopilot_params" in opinion.wanted else _WEIGHT_TABLE
    found = "not told" if value is None else f"{value:g}"
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
