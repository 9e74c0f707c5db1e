"""The verbs of the command line that are orders to agents, made from the table of the operator's verbs.

Heavy modules are imported inside the verb that needs them, as in `swarmctl.ops.cli`.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swarmctl.core.operator_verbs import (
    FAR,
    GOTO,
    MISSION,
    OPERATOR_VERBS,
    POINT,
    SPEED,
    YAW,
    OperatorVerb,
    Order,
    VerbArgument,
    order_problem,
)
from swarmctl.errors import EXIT_OK, ConfigError, MissionError

if TYPE_CHECKING:
    from swarmctl.ops.orders.order_delivery import Reply

Run = Annotated[
    str | None,
    typer.Option(
        "--run", "--run-dir", metavar="NAME|DIR", help="Launch to act on, by name or run folder; default: the only one."
    ),
]
AskedAgents = Annotated[list[int] | None, typer.Argument(metavar="AGENT", help="Agents asked; default: all.")]
MoreAgents = Annotated[list[int] | None, typer.Option("--agent", help="Agent asked, as an option; repeatable.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_ANSWERS = "Exit code 0: every agent asked has accepted; 4: one has refused, or has not answered in time, and is named."


def add_order_verbs(to: typer.Typer) -> None:
    """Add every verb that is an order to agents to a command line."""
    for name, verb in OPERATOR_VERBS.items():
        if name not in (GOTO, MISSION):  # a point is one argument, and a mission a file
            add_operator_verb(to, name, verb)
    minus = {"ignore_unknown_options": True}  # a point may begin with one
    to.command(GOTO, help=f"{OPERATOR_VERBS[GOTO].help} {_ANSWERS}", context_settings=minus)(_goto)


def _option(argument: VerbArgument) -> Any:
    """Return the option of the command line that carries one number of an order."""
    return typer.Option(argument.option, min=argument.least, max=argument.most, help=argument.help)


def _option_of(verb: str, name: str) -> Any:
    return _option(_argument_of(verb, name))


def _flag_of(verb: str, name: str) -> Any:
    argument = _argument_of(verb, name)
    return typer.Option(argument.option, help=argument.help)


def _argument_of(verb: str, name: str) -> VerbArgument:
    return next(argument for argument in OPERATOR_VERBS[verb].arguments if argument.name == name)


def _give(order: Order, run: str | None, agents: list[int], as_json: bool) -> int:
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders.order_delivery import deliver

    launch = running_launches.find_launch(run)
    return told(order.verb, launch.run, lambda: deliver(launch, order, agents), as_json=as_json)


def told(verb: str, run: str, give: Callable[[], Sequence[Reply]], *, as_json: bool = False) -> int:
    """Give an order to a launch, and print what each agent has answered; returns the exit code.

    Raises:
        MissionError: an agent refuses, or is silent.
    """
    if not as_json:
        print(f"{verb}: {run}")
    replies = give()
    if as_json:
        print(json.dumps({"run": run, "order": verb, "agents": [reply.as_dict() for reply in replies]}, indent=2))
    else:
        for reply in replies:
            print(reply.line)
    if failed := [f"agent-{reply.agent}" for reply in replies if reply.problem]:  # why has just been printed
        raise MissionError(f"{verb}: {len(failed)} of {len(replies)} not known to obey: {', '.join(failed)}")
    return EXIT_OK


def add_operator_verb(
    to: typer.Typer, name: str, verb: OperatorVerb, give: Callable[[Order, str | None, list[int], bool], int] = _give
) -> None:
    """Add a verb of the operator, with an option for each of its arguments.

    Args:
        to: command line to extend.
        name, verb: entry of `OPERATOR_VERBS`.
        give: gives the order to a launch, to the agents named or to all, and prints the answers, as JSON or in words;
            returns the exit code.
    """

    def run(
        asked: AskedAgents = None,
        run: Run = None,
        agent: MoreAgents = None,
        as_json: AsJson = False,
        **arguments: float | None,
    ) -> int:
        given = {name: value for name, value in arguments.items() if value is not None}
        return give(Order(name, given), run, [*(asked or ()), *(agent or ())], as_json)

    parameters = [*inspect.signature(run, eval_str=True).parameters.values()][:-1]
    for argument in verb.arguments:
        default = inspect.Parameter.empty if argument.required else None
        option = _option(argument)
        annotation = Annotated[float, option] if argument.required else Annotated[float | None, option]
        kind = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(argument.name, kind, annotation=annotation, default=default))
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # typer derives options from it
    to.command(name, help=f"{verb.help} {_ANSWERS}")(run)


def _goto(
    agent: Annotated[int, typer.Argument(metavar="AGENT", help="Agent asked.")],
    point: Annotated[str, typer.Argument(metavar="N,E,D", help="Point, shared NED [m]; up is negative.")],
    yaw: Annotated[float | None, _option_of(GOTO, YAW)] = None,
    speed: Annotated[float | None, _option_of(GOTO, SPEED)] = None,
    far: Annotated[bool, _flag_of(GOTO, FAR)] = False,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    from swarmctl.ops.orders import operator

    problems: list[str] = []
    arguments = dict(zip(POINT, operator.vector("N,E,D", point, problems), strict=True))
    chosen = ((YAW, yaw), (SPEED, speed), (FAR, 1.0 if far else None))
    arguments |= {name: value for name, value in chosen if value is not None}
    if problem := "".join(problems) or order_problem(GOTO, arguments):
        raise ConfigError(GOTO, [problem])
    return _give(Order(GOTO, arguments), run, [agent], as_json)
