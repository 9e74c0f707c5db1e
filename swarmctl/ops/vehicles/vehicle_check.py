"""`swarmctl check`: scans all vehicles of a configuration at once, and prints one table and what to fix.

Nothing is changed without `--apply`, and with it only wanted parameters of vehicles that are disarmed on the ground. A
configured built-in simulator is started for the check and ended with it.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from swarmctl.check.change import Change
from swarmctl.check.computer import priority_finding
from swarmctl.check.parameters import Number, changes, unchangeable
from swarmctl.check.scan.link_facts import ArmingProblem, FenceFacts, VehicleFacts
from swarmctl.check.scan.scanner import VehicleScan, run_scans
from swarmctl.check.services import corners_deg, has_fence, wants_fence
from swarmctl.check.swarm import exit_code, findings, standing
from swarmctl.check.table import as_json, print_check
from swarmctl.config import Config
from swarmctl.configuration.config_warnings import warning_lines
from swarmctl.configuration.constraints import one_place_at_two_hosts
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.processes import wants_realtime
from swarmctl.ops.vehicles.vehicle_links import VehicleLinks, open_links
from swarmctl.process_lifetime import StopRequest
from swarmctl.process_priority import is_realtime_permitted

if TYPE_CHECKING:
    from swarmctl.check.ground_services import GroundVehicle

_CONNECT_S = 5.0  # heartbeats come once a second
_LONGER_S = 8.0  # for parameters over a slow link
_APPLY_S = 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckOptions:
    """Options of the check that are not part of the configuration."""

    apply: bool = False
    seconds: float = 3.0  # time to listen to every vehicle after its first heartbeat
    json: Path | None = None
    connect_s: float = _CONNECT_S
    agents: tuple[int, ...] | None = None  # those whose vehicles are checked; None: all
    to_fly: bool = False  # a flight follows: armed vehicles are findings, because another party flies them


def agents_of(config: Config, host: str | None) -> tuple[int, ...] | None:
    """Return the agents whose vehicles are reached from one computer; None for all of them.

    Args:
        config: of the whole swarm.
        host: name of this computer in `[[hosts]]`; None: it is not said.

    Raises:
        ConfigError: there is no such host, or it has to be said, as another vehicle would be taken for the one meant.
    """
    if host is not None:
        agents = next((known.agents for known in config.hosts if known.name == host), None)
        if agents is None:
            names = ", ".join(known.name for known in config.hosts) or "none"
            raise ConfigError("--host", [f"{host!r}: no such computer in [[hosts]]; there are: {names}"])
        return tuple(sorted(agents))
    if not config.sitl.enabled and (pair := one_place_at_two_hosts(config.vehicles, config.hosts)) is not None:
        names = ", ".join(known.name for known in config.hosts)
        place = f"vehicles.{pair[0]} and vehicles.{pair[1]} are at {config.vehicles[pair[1]].url} of two computers"
        raise ConfigError("--host", [f"{place}: name the one that this is, of {names}"])
    return None


def check(config: Config, options: CheckOptions) -> int:
    """Check the vehicles of a configuration and return the exit code.

    Raises:
        StartError: the built-in simulator does not come up, or the JSON file can't be written.
    """
    if options.json is not None and not options.json.parent.is_dir():  # told before every vehicle is asked
        raise StartError(f"{options.json}: {options.json.parent} is no folder. Choose another with --json")
    if options.json is not None and options.json.is_dir():
        raise StartError(f"{options.json}: can't be written: it is a folder. Choose another with --json")
    for line in warning_lines(config):
        print(line, file=sys.stderr)
    ended_cleanly = StopRequest(signal.SIGTERM, signal.SIGHUP, raise_at=1)  # so that started processes are ended
    with ended_cleanly, open_links(config, options.connect_s, options.agents) as opened:
        vehicles, changed = _scan(config, options, opened)
    asks = wants_realtime(config, options.agents or range(config.swarm.agents))
    lines = findings(vehicles, config)
    lines.append(priority_finding(is_wanted=asks, is_permitted=is_realtime_permitted()))
    lines += [change.finding() for change in changed if not change.done]
    if options.to_fly:
        lines += standing(vehicles)
    code = exit_code(vehicles, lines)
    print_check(vehicles, lines, changed)
    if options.json is not None:
        text = as_json(vehicles, lines, changed, code)
        try:
            options.json.write_text(text, encoding="utf-8")
        except OSError as error:
            raise StartError(f"{options.json}: can't be written: {error}. Choose another with --json") from error
    return code


@dataclass(frozen=True, slots=True, kw_only=True)
class _Served:
    """What one vehicle was given, and has told, by MAVSDK."""

    disarmed: bool  # all the time while parameters were set
    arming_problems: tuple[ArmingProblem, ...] | None
    fence: FenceFacts | None


def _scan(config: Config, options: CheckOptions, opened: VehicleLinks) -> tuple[list[VehicleFacts], list[Change]]:
    scans = opened.scans(config, options.seconds)
    longest_s = opened.connect_s + options.seconds + opened.patience_s + _LONGER_S
    run_scans(list(scans.values()), opened.connect_s, longest_s, opened.ended)
    if opened.simulator is not None and opened.ended():
        raise StartError(f"built-in simulator {opened.simulator.how_it_ended()}")
    before = opened.facts(config, scans)
    wanted = {facts.agent: changes(facts, config) if options.apply else {} for facts in before}
    served = _serve(config, options, before, wanted, scans=scans)
    if any(wanted.values()):
        for agent in served:
            if (reader := scans[agent].parameters) is not None:
                reader.read_again(wanted[agent])
        run_scans(list(scans.values()), 0.0, _APPLY_S, opened.ended)
    after = [
        replace(facts, arming_problems=told.arming_problems, fence=told.fence)
        if (told := served.get(facts.agent))
        else facts
        for facts in opened.facts(config, scans)
    ]
    return after, [
        _changed(was, now, name, value, served=served.get(was.agent))
        for was, now in zip(before, after, strict=True)
        for name, value in wanted[was.agent].items()
    ]


def _serve(
    config: Config,
    options: CheckOptions,
    vehicles: Sequence[VehicleFacts],
    wanted: Mapping[int, Mapping[str, Number]],
    *,
    scans: Mapping[int, VehicleScan],
) -> dict[int, _Served]:
    """Let MAVSDK serve the vehicles that need it, all at once, unless they are armed or in the air."""
    jobs = {
        facts.agent: partial(_job, config=config, apply=options.apply, facts=facts, wanted=wanted[facts.agent])
        for facts in vehicles
        if not unchangeable(facts) and (facts.has_metadata or wants_fence(facts, config) or wanted[facts.agent])
    }
    if not jobs:
        return {}
    from swarmctl.check.ground_services import open_services  # heavy, and most checks of the simulator do not need it

    with open_services({agent: scans[agent] for agent in jobs}) as services:
        return services.ask(jobs)


def _job(
    vehicle: GroundVehicle, *, config: Config, apply: bool, facts: VehicleFacts, wanted: Mapping[str, Number]
) -> _Served:
    parameters = facts.parameters or {}
    typed = {n: round(v) if isinstance(parameters[n].value, int) else float(v) for n, v in wanted.items()}
    disarmed = vehicle.set_parameters(typed)
    fence = vehicle.fence() if wants_fence(facts, config) else None
    if fence is not None and apply and not has_fence(fence, config):
        fence = vehicle.upload_fence(corners_deg(config))
    problems = vehicle.arming_checks() if facts.has_metadata else None
    return _Served(disarmed=disarmed, arming_problems=problems, fence=fence)


def _changed(was: VehicleFacts, now: VehicleFacts, name: str, wanted: Number, *, served: _Served | None) -> Change:
    refused = unchangeable(was)
    if not refused and served is None:
        refused = "it was not found again"
    elif not refused and served is not None and not served.disarmed:
        refused = "it was armed, or fell silent, meanwhile"
    before = was.number(name)
    assert before is not None  # `changes` leaves out unknown values
    return Change(agent=was.agent, name=name, before=before, wanted=wanted, after=now.number(name), refused=refused)
