"""Ports that other processes will listen on: no two that look for one at the same time find the same."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from pathlib import Path

import pytest
import rerun as rr

from swarmctl.telemetry.view import view_ports, viewer
from swarmctl.telemetry.view.view_ports import HOST, held_view_port

FIRST = 19_090


def test_a_port_that_is_held_is_nobody_elses_until_it_is_given_back() -> None:
    with held_view_port(FIRST) as one, held_view_port(FIRST) as other:
        assert FIRST <= one < other
        assert view_ports._is_free(one), "nothing listens on it yet: who only looks finds it again"
    with held_view_port(FIRST) as again:
        assert again == one


def test_what_is_held_can_be_listened_on_and_what_is_listened_on_is_not_held() -> None:
    with held_view_port(FIRST) as held, socket.create_server((HOST, held)), held_view_port(FIRST) as other:
        assert other > held
    with socket.create_server((HOST, held)), held_view_port(FIRST) as beside:
        assert beside > held, "a program that holds nothing"


def test_a_port_that_is_held_is_not_even_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """To look binds it, in the moment in which its holder's server may do so."""
    looked_at: list[int] = []
    is_free = view_ports._is_free

    def noted(port: int) -> bool:
        looked_at.append(port)
        return is_free(port)

    with held_view_port(FIRST) as held:
        monkeypatch.setattr(view_ports, "_is_free", noted)
        with held_view_port(FIRST) as other:
            assert looked_at[-1] == other and held not in looked_at


def test_no_port_is_said_as_zero() -> None:
    with ExitStack() as held:
        found = [held.enter_context(held_view_port(65_536 - 3)) for _ in range(4)]
        assert found[-1] == 0 and len({*found}) > 1


def test_a_viewer_serves_on_no_port_that_another_one_is_about_to_bind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Both found the same port free, and who lost it waited 2 s before it tried the next."""
    served, seen = list[int](), list[int]()

    def serve(host: str, port: int, **_: object) -> object:
        served.append(port)
        with held_view_port(port) as other:
            seen.append(other)
        return rr.FileSink(str(tmp_path / "sunk.rrd"))

    monkeypatch.setattr(rr, "GrpcServerSink", serve)
    monkeypatch.setattr(viewer, "_is_ours", lambda port: port != served[0])
    with held_view_port(FIRST) as held:
        rec, url = viewer._serve("run", tmp_path, held, 16)
        rec.disconnect()
    assert held < served[0] < served[1]
    assert url.endswith(f":{served[1]}/proxy")
    assert all(other > port for port, other in zip(served, seen, strict=True)), "it holds its own meanwhile"
