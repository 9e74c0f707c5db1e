"""The verbs of the command line: each reads its arguments and calls the module that does the work.

Heavy modules are imported inside the verb that needs them, so that `--help` answers in a fraction of a second.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from swarmctl import __version__
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_USAGE, ConfigError, StartError, SwarmError, exit_code_of
from swarmctl.ops.verbs.agent import add_agent_verb
from swarmctl.ops.verbs.configuration import config_app
from swarmctl.ops.verbs.folders import Web, add_folder_verbs, show_in_browser
from swarmctl.ops.verbs.hosts import add_host_verbs
from swarmctl.ops.verbs.keys import keys_app
from swarmctl.ops.verbs.mission import mission_app
from swarmctl.ops.verbs.obstacles import obstacle_app
from swarmctl.ops.verbs.orders import AsJson, Run, add_order_verbs
from swarmctl.process_lifetime import module_command
from swarmctl.standard_streams import output_is_lost

if TYPE_CHECKING:
    from collections.abc import Collection

    from swarmctl.bus.messages.json_messages import StatusMessage
    from swarmctl.ops.running_launches import RunningLaunch

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # markup would take units such as [m] for tags and drop them
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Fly a swarm of quadrotors with one distributed-MPC agent beside every autopilot.",
)
app.add_typer(obstacle_app, name="obstacle")
app.add_typer(mission_app, name="mission")
app.add_typer(config_app, name="config")
app.add_typer(keys_app, name="keys")

ConfigPath = Annotated[Path | None, typer.Argument(help="TOML file; default: the circle of the thesis.")]
Agents = Annotated[int | None, typer.Option("--agents", help="Number of agents; overrides swarm.agents.")]
Duration = Annotated[float | None, typer.Option("--duration", help="Duration of the mission [s].")]
Seed = Annotated[int | None, typer.Option("--seed", help="Seed of every random stream.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a configuration key; repeatable.")
]
NewRunDir = Annotated[Path | None, typer.Option("--run-dir", help="Run folder to create; default runs/<UTC>-<name>.")]
View = Annotated[
    bool | None, typer.Option("--view/--no-view", help="Open the viewer window, or none; recorded either way.")
]
WebPage = Annotated[
    bool, typer.Option("--web", help="Serve the view to browsers of this computer; no window, unless --view.")
]
_WATCH_S = 0.25
_MOST_VEHICLES = 100
# The verb's module declares the options, and answers --help.
_PASS_ON = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


def main() -> None:
    """Run the command line: print expected errors and return their exit code, let unexpected ones raise."""
    code = exit_code_of(_run_app)
    if _bus_is_blocked():
        atexit._run_exitfuncs()
        os._exit(code)
    sys.exit(code)


def _bus_is_blocked() -> bool:
    """Return whether the bus, where a verb has loaded it, would abort the process as the interpreter ends."""
    bus = sys.modules.get("swarmctl.bus.zenoh.client")
    return bus is not None and bus.is_blocked()


def _run_app() -> int:
    try:
        code = app(standalone_mode=False)
    except typer.Abort:
        return EXIT_INTERRUPTED
    except SwarmError:
        raise
    except Exception as error:
        show = getattr(error, "show", None)  # usage errors of whichever click typer brings
        if show is None or not hasattr(error, "exit_code"):
            raise
        show()
        return EXIT_USAGE
    return code if isinstance(code, int) else EXIT_OK


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"swarmctl {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    return


@app.command()
def launch(
    config: ConfigPath = None,
    agents: Agents = None,
    duration: Duration = None,
    run_dir: NewRunDir = None,
    seed: Seed = None,
    sets: Set = None,
    view: View = None,
    web: WebPage = False,
    pin: Annotated[
        bool, typer.Option("--pin", help="Bind each process of agents to one processor: agent.pinned=true.")
    ] = False,
) -> int:
    """Start simulator, agents, bus and view, and fly. Ctrl-C lands; a second Ctrl-C kills every process."""
    from swarmctl.config import load
    from swarmctl.ops.flight.launch import LaunchOptions
    from swarmctl.ops.flight.launch import launch as fly
    from swarmctl.telemetry.view.recordings import wants_window

    options = LaunchOptions(run_dir, wants_window(view, web=web), web)
    pinned = ["agent.pinned=true"] if pin else []
    return fly(load(config, [*_overrides(agents, duration, seed, sets), *pinned]), options)


@app.command()
def simulate(
    config: ConfigPath = None,
    agents: Agents = None,
    duration: Duration = None,
    run_dir: NewRunDir = None,
    seed: Seed = None,
    sets: Set = None,
    view: View = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            help="Processes that share the agents, the result is the same; default: all processors.",
        ),
    ] = None,
) -> NoReturn:
    """Fly the same agents on a simulated clock. Deterministic, faster than real time."""
    arguments = [] if config is None else [str(config)]
    for name, value in (
        ("--agents", agents),
        ("--duration", duration),
        ("--run-dir", run_dir),
        ("--seed", seed),
        ("--jobs", jobs),
    ):
        arguments += [] if value is None else [f"{name}={value}"]
    arguments += [f"--set={item}" for item in sets or ()]
    arguments += [] if view is None else ["--view" if view else "--no-view"]
    _become("sitl.simulate", arguments)


@app.command()
def check(
    config: ConfigPath = None,
    agents: Agents = None,
    host: Annotated[
        str | None, typer.Option("--host", metavar="NAME", help="Of [[hosts]]: check the vehicles of this one only.")
    ] = None,
    sets: Set = None,
    apply: Annotated[
        bool, typer.Option("--apply", help="Set the wanted parameters of disarmed vehicles; default: change nothing.")
    ] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", min=1.0, max=600.0, help="Time to listen to each vehicle [s].")
    ] = 3.0,
    json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write all findings to FILE.")
    ] = None,
    identify: Annotated[
        bool, typer.Option("--identify", help="Then FLY small steps and identify delay, lag, drag and thrust.")
    ] = False,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FILE", help="With --identify: write the vehicle model as TOML.")
    ] = None,
) -> int:
    """Pre-flight check of every vehicle. Exit code 0: ready; 3: a vehicle is not reached; 4: something is to fix."""
    from swarmctl.config import load
    from swarmctl.ops.vehicles.vehicle_check import CheckOptions, agents_of
    from swarmctl.ops.vehicles.vehicle_check import check as check_vehicles

    if write is not None and not identify:
        raise ConfigError("--write", ["there is nothing to write without --identify"])
    if host is not None and identify:
        raise ConfigError("--host", ["--identify flies all vehicles by a launch; give a configuration of this host's"])
    overrides = _overrides(agents, None, None, sets)
    chosen = agents_of(load(config, overrides, only_agents=()), host)
    asked = load(config, overrides, only_agents=chosen)  # signing keys of the others are on other computers
    options = CheckOptions(apply=apply, seconds=seconds, json=json, agents=chosen)
    if not identify:
        return check_vehicles(asked, options)
    from swarmctl.ops.vehicles.identify import IdentifyOptions, check_and_identify

    return check_and_identify(asked, IdentifyOptions(options, write))


add_agent_verb(app)
add_host_verbs(app)


@app.command()
def status(
    run: Run = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON; with --watch one line at a time.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Go on until the launch ends, or Ctrl-C.")] = False,
) -> int:
    """Show the status of every agent of a running launch."""
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import operator

    launch = running_launches.find_launch(run)
    if watch:
        with contextlib.suppress(KeyboardInterrupt):
            _watch(launch, as_json)
        return EXIT_OK
    statuses, gone = operator.read_agents(launch)
    if as_json:
        print(operator.as_json(statuses))
    else:
        _show(launch, statuses, gone)
    return EXIT_OK


def _watch(launch: RunningLaunch, as_json: bool) -> None:
    """Show statuses until the launch ends: a live table, lines where there is no terminal, or lines of JSON."""
    from swarmctl.ops.orders import operator
    from swarmctl.ops.supervision.status_table import AgentView, open_display

    views = [AgentView(agent=agent) for agent in range(launch.agents)]
    display = None if as_json else open_display(run=launch.run)
    try:
        for statuses in operator.watch_statuses(launch, _WATCH_S):
            for agent, status in statuses.items():
                views[agent].status, views[agent].received_s = status, time.monotonic()
            if display is not None:
                display.show(views)
            elif statuses:
                print(operator.as_json(statuses, indent=None), flush=True)
            if output_is_lost():
                return
    finally:
        if display is not None:
            display.close()


add_order_verbs(app)


@app.command()
def fault(
    kind: Annotated[str, typer.Argument(help="gps_loss, motor, link_loss, gust, ...; an unknown kind lists all.")],
    vehicle: Annotated[int, typer.Option("--vehicle", help="Vehicle index, from 0; -1: all.")] = -1,
    value: Annotated[float | None, typer.Option("--value", help="Magnitude, in the unit of the kind.")] = None,
    for_s: Annotated[float, typer.Option("--for", help="Duration [s]; 0: to the end.")] = 0.0,
    rotor: Annotated[int, typer.Option("--rotor", help="Rotor of a motor fault, 0 to 3.")] = 0,
    direction: Annotated[
        str, typer.Option("--direction", help="Link direction: both, to_vehicle, from_vehicle.")
    ] = "both",
    towards: Annotated[float, typer.Option("--towards", help="Direction of a gust or jump [deg from north].")] = 0.0,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Inject a fault into the simulator of a running launch. Refused where real vehicles fly."""
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import fault as faults

    wanted = {"kind": kind, "vehicle": vehicle, "value": value, "for_s": for_s, "rotor": rotor}
    wanted |= {"direction": direction, "towards_deg": towards}
    try:
        launch = running_launches.find_launch(run)
    except StartError:
        faults.parse_fault(wanted, _MOST_VEHICLES)  # whose kinds are listed without a launch, too
        raise
    asked = faults.parse_fault(wanted, launch.agents)
    since_boot_s = faults.inject(launch, asked)
    if as_json:
        print(faults.as_json(launch.run, asked, since_boot_s))
    else:
        print(f"fault: {launch.run}\n{faults.line_of(asked, since_boot_s)}")
    return EXIT_OK


@app.command()
def view(run: Run = None, web: Web = False) -> int:
    """Open the live view of a running launch."""
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import operator
    from swarmctl.telemetry.view.recordings import open_viewer

    address = operator.view_address(running_launches.find_launch(run))
    if web:
        return show_in_browser(address)
    open_viewer(address)
    return EXIT_OK


add_folder_verbs(app)


@app.command(context_settings=_PASS_ON)
def reproduce(context: typer.Context) -> NoReturn:
    """Reproduce the six experiments of the thesis. Writes each result beside the published figure."""
    _become("sitl.studies.thesis.command", context.args)


@app.command(context_settings=_PASS_ON)
def bench(context: typer.Context) -> NoReturn:
    """Measure the tick of one agent, part by part. Covers 0 to 30 neighbours and each installed solver."""
    _become("sitl.studies.bench.command", context.args)


@app.command(context_settings=_PASS_ON)
def sweep(context: typer.Context) -> NoReturn:
    """Fly every combination of values in lockstep, on all processors. Writes a table and charts; can be resumed."""
    _become("sitl.studies.sweep.command", context.args)


@app.command(context_settings=_PASS_ON)
def campaign(context: typer.Context) -> NoReturn:
    """Fly seeded Monte Carlo campaigns in lockstep, and count collisions and arrivals. Can be resumed."""
    _become("sitl.studies.campaign.command", context.args)


def _become(module: str, arguments: list[str]) -> NoReturn:
    """Replace this process by a module of the simulator, which the bridge never imports."""
    sys.stdout.flush()
    os.execv(sys.executable, [*module_command("sitl.verb", module, *arguments)])


def _overrides(agents: int | None, duration: float | None, seed: int | None, sets: list[str] | None) -> list[str]:
    """Return the options as `--set` items, the named ones last so that they take precedence."""
    named = (("swarm.agents", agents), ("mission.duration_s", duration), ("seed", seed))
    return [*(sets or ()), *(f"{key}={value}" for key, value in named if value is not None)]


def _show(launch: RunningLaunch, statuses: dict[int, StatusMessage], gone: Collection[int]) -> None:
    from swarmctl.ops.orders.operator import HAS_ENDED
    from swarmctl.ops.supervision.status_table import AgentView, print_statuses

    print(f"status: {launch.run}", file=sys.stderr)  # rows alone on standard output
    views = [AgentView(agent=number, status=statuses.get(number)) for number in range(launch.agents)]
    for view in views:
        if view.status is None:
            view.note = HAS_ENDED if view.agent in gone else "not heard"
    print_statuses(views, launch.run)
