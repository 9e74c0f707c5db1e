"""Plays the steps of a row in a dialogue and raises when the answer differs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from tests.conformance import vocabulary as v
from tests.conformance.dialogue import Arrived, Deviation, Dialogue, same_bits, wire_value
from tests.conformance.fields import fits
from tests.conformance.motion import MEASURES

LIST_AT_MOST = 4  # values shown in a complaint
OF_THE_LOGGER = "[logger]"


def command_message(step: v.Command) -> v.Message:
    params = [*step.params, *[0.0] * (7 - len(step.params))]
    names: tuple[str, ...] = ("param5", "param6", "param7")
    fields: dict[str, Any] = {f"param{i + 1}": params[i] for i in range(4)}
    if step.as_int:
        names, params = ("x", "y", "z"), [*params[:4], int(params[4]), int(params[5]), params[6]]
    fields |= dict(zip(names, params[4:], strict=True))
    system, component = step.target
    return v.Message(
        "COMMAND_INT" if step.as_int else "COMMAND_LONG",
        {"target_system": system, "target_component": component, "command": step.number, **fields},
    )


def matches(message: Any, fields: Mapping[str, Any]) -> bool:
    return message is not None and all(fits(getattr(message, name), wanted) for name, wanted in fields.items())


class Verifier:
    """Steps against one dialogue."""

    def __init__(self, dialogue: Dialogue) -> None:
        self._d = dialogue
        self._handlers: dict[type, Callable[[Any], None]] = {
            v.Send: self._send,
            v.Command: self._command,
            v.SetParam: self._set_param,
            v.Stream: self._d.stream,
            v.Stop: lambda _: self._d.stop(),
            v.PauseHeartbeats: lambda s: (self._d.paused.add if s.paused else self._d.paused.discard)(s.link),
            v.Wait: lambda s: self._d.run(s.seconds),
            v.Mark: lambda _: self._d.set_mark(),
            v.Sees: self._sees,
            v.Never: self._never,
            v.Always: self._always,
            v.Says: self._says,
            v.SaysNothing: self._says_nothing,
            v.Turns: self._turns,
            v.First: self._first,
            v.At: lambda s: self._d.run(self._d.begun_s + s.since_start_s - self._d.partner.now_s()),
            v.Passes: self._passes,
            v.Rate: self._rate,
            v.Moves: self._moves,
        }

    def verify(self, step: v.Step) -> None:
        """Raises `Deviation` when it is not met."""
        self._handlers[type(step)](step)

    # --- sending ---

    def _send(self, step: v.Send) -> None:
        for repeat in range(step.times):
            if repeat:
                self._d.run(step.every_s)
            self._d.send(step.what, step.link)

    def _command(self, step: v.Command) -> None:
        self._d.send(command_message(step), step.link)
        answers: list[Any] = []

        def answered() -> bool:
            acks = (a.message for a in self._d.since_mark("COMMAND_ACK", step.link))
            answers[:] = [m for m in acks if m is not None and m.command == step.number]
            return bool(answers)

        if step.ack == v.NO_ACK:
            if self._d.run_until(answered, max(0.3, step.within_s)):
                raise Deviation(f"acknowledged with {answers[0].result}")
            return
        if not self._d.run_until(answered, step.within_s):
            raise Deviation(f"no ack within {step.within_s} s")
        own = self._d.own_ids(step.link)
        wanted = {"result": step.ack, "progress": 0, "result_param2": 0, "target_system": own[0]}
        self._require(answers[0], wanted | {"target_component": own[1]})

    def _require(self, message: Any, wanted: Mapping[str, Any]) -> None:
        for name, value in wanted.items():
            if not fits(getattr(message, name), value):
                raise Deviation(f"{name} is {getattr(message, name)!r}, wanted {value!r}")

    def _set_param(self, step: v.SetParam) -> None:
        value, kind = wire_value(step.value), v.INT32 if isinstance(step.value, int) else v.REAL32
        fields = {"target_system": v.OWN, "target_component": 1, "param_id": step.name, "param_type": kind}
        self._d.send(v.Message("PARAM_SET", {**fields, "param_value": value}))

        def stored() -> bool:
            answers = (a.message for a in self._d.since_mark("PARAM_VALUE", v.OFFBOARD_LINK))
            return any(m and m.param_id == step.name and same_bits(m.param_value, value) for m in answers)

        if not self._d.run_until(stored, 0.5):
            raise Deviation("not stored within 0.5 s")

    # --- looking ---

    def _seen(self, name: str | int, link: str, *, forwarded: bool = False) -> list[Arrived]:
        return self._d.since_mark(name, link, forwarded=forwarded)

    def _instead(self, arrived: Iterable[Arrived], fields: Mapping[str, Any]) -> str:
        shown: list[str] = []
        for message in (a.message for a in arrived):
            text = str({name: getattr(message, name) for name in fields})
            if not shown or shown[-1] != text:
                shown.append(text)
        return f"came instead: {', '.join(shown[-LIST_AT_MOST:])}" if shown else "none came"

    def _sees(self, step: v.Sees) -> None:
        after_s = self._d.mark_s + step.not_before_s
        looked = 0

        def met() -> bool:
            nonlocal looked
            news = self._seen(step.name, step.link, forwarded=step.forwarded)
            new, looked = news[looked:], len(news)
            late = [a for a in new if not step.not_before_s or a.t_s >= after_s - 1e-9]
            return any(not step.fields or matches(a.message, step.fields) for a in late)

        if not self._d.run_until(met, step.within_s):
            instead = self._instead(self._seen(step.name, step.link), step.fields)
            raise Deviation(f"not within {step.within_s} s; {instead}")

    def _never(self, step: v.Never) -> None:
        self._d.run_until(lambda: False, step.for_s)
        for arrived in self._seen(step.name, step.link):
            if not step.fields or matches(arrived.message, step.fields):
                raise Deviation(f"came {arrived.t_s - self._d.mark_s:.3f} s later: {arrived.message}")

    def _always(self, step: v.Always) -> None:
        self._d.set_mark()
        self._d.run(step.for_s)
        came = self._seen(step.name, step.link)
        if len(came) < step.at_least:
            raise Deviation(f"{len(came)} came, wanted {step.at_least}")
        for arrived in came:
            self._require(arrived.message, step.fields)

    def _says(self, step: v.Says) -> None:
        pattern = step.text if step.is_pattern else re.escape(step.text)

        def said() -> bool:
            return any(s == step.severity and re.fullmatch(pattern, text) for s, text in self._d.texts())

        if not self._d.run_until(said, step.within_s):
            raise Deviation(f"not said within {step.within_s} s; said: {self._d.texts()}")

    def _says_nothing(self, step: v.SaysNothing) -> None:
        self._d.run_until(lambda: False, step.for_s)
        said = [(severity, text) for severity, text in self._d.texts() if not text.startswith(OF_THE_LOGGER)]
        if said:
            raise Deviation(f"said: {said}")

    def _turns(self, step: v.Turns) -> None:
        changed: list[float] = []

        def met() -> bool:
            changed[:] = [
                a.t_s - self._d.mark_s
                for a in self._seen(step.name, v.OFFBOARD_LINK)
                if a.message is not None and getattr(a.message, step.field) == step.value
            ]
            return bool(changed)

        if not self._d.run_until(met, step.high_s):
            instead = self._instead(self._seen(step.name, v.OFFBOARD_LINK), {step.field: step.value})
            raise Deviation(f"not within {step.high_s} s; {instead}")
        if changed[0] < step.low_s:
            raise Deviation(f"after {changed[0]:.3f} s already")

    def _first(self, step: v.First) -> None:
        def arrived() -> list[float]:
            return [a.t_s - self._d.begun_s for a in self._d.all_of(step.name, v.OFFBOARD_LINK)]

        self._d.set_mark()
        if not self._d.run_until(lambda: bool(arrived()), step.high_s):
            raise Deviation("none came")
        if not step.low_s <= arrived()[0] <= step.high_s:
            raise Deviation(f"came after {arrived()[0]:.3f} s")

    def _passes(self, step: v.Passes) -> None:
        passed: list[int] = []

        def met() -> bool:
            passed.clear()
            for arrived in self._seen(step.name, v.OFFBOARD_LINK):
                value = getattr(arrived.message, step.field)
                if not passed and value != step.values[0]:
                    continue  # still where it was before
                if not passed or passed[-1] != value:
                    passed.append(value)
            return len(passed) >= len(step.values)

        self._d.run_until(met, step.within_s)
        if tuple(passed) != step.values:
            raise Deviation(f"passed {passed}")

    def _rate(self, step: v.Rate) -> None:
        self._d.set_mark()
        self._d.run(step.for_s)
        rate_hz = len(self._seen(step.name, step.link)) / step.for_s
        if not step.hz.accepts(rate_hz):
            raise Deviation(f"{rate_hz:.2f} Hz")

    def _moves(self, step: v.Moves) -> None:
        measure = MEASURES[step.measure]
        self._d.run_until(lambda: False, step.for_s)
        samples = [(a.t_s - self._d.mark_s, a.message) for a in self._seen(measure.source, v.OFFBOARD_LINK)]
        if not samples:
            raise Deviation(f"no {measure.source}")
        figure = measure.of(samples)
        if not step.wanted.accepts(figure):
            raise Deviation(f"{figure:.4g}")
