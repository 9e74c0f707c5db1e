"""Tests that alerts are shown while their cause lasts and expire afterwards."""

from __future__ import annotations

from swarmctl.agent.watches.alerts import Alerts

SECOND = 1_000_000


def shown(alerts: Alerts, now_us: int) -> str:
    newest = alerts.newest(now_us)
    return "" if newest is None else newest.text


def test_the_newest_alert_is_shown_and_ends_after_its_cause() -> None:
    alerts = Alerts()
    assert shown(alerts, 0) == ""
    assert alerts.put("plan", "plan not certified", 0)
    assert alerts.put("link", "state lost", 1 * SECOND)
    assert not alerts.put("plan", "plan residual", 2 * SECOND), "it has begun before"
    assert shown(alerts, 2 * SECOND) == "state lost"
    assert shown(alerts, round(3.5 * SECOND)) == "plan residual"
    assert shown(alerts, 5 * SECOND) == ""


def test_a_cleared_alert_is_not_shown() -> None:
    alerts = Alerts()
    alerts.put("takeoff", "takeoff refused: result 4", 0)
    alerts.clear("takeoff")
    assert shown(alerts, 0) == ""
