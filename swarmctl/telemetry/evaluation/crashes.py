"""Finds vehicles that crashed: they turned over, or touched the ground while their agents flew them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import FLOWN_BY_AGENT, Mode, Phase
from swarmctl.telemetry.evaluation.attitude import tilt_rad
from swarmctl.telemetry.evaluation.tracks import Tracks

_OVER_RAD = 1.4  # no plan tilts as much
_SAME_INSTANT_US = 200_000  # largest time between a tick and the position that counts for it
_CONTACT_M = 0.03  # centres of vehicles that stand are at the ground's height


def crashes(
    ticks: Mapping[int, NDArray[np.void]], tracks: Tracks, ground_z_m: float | None, at_s: Callable[[float], float]
) -> Iterator[str]:
    """Yield what happened to each vehicle first, in words.

    Who turns over crashes whoever flies it, from take-off to landing, but for pilots, who do as they like. The ground
    counts only where the agent flies, from its start position to its landing place: autopilots take off and land.

    Args:
        ticks: by agent, rows of `TICK_DTYPE`.
        tracks: positions of all agents.
        ground_z_m: down coordinate of the ground; None where it is unknown, as of real vehicles.
        at_s: returns the mission time of an instant.
    """
    for agent, rows in sorted(ticks.items()):
        in_air = rows[(rows["phase"] >= Phase.TAKEOFF) & (rows["phase"] < Phase.DONE)]
        over = (tilt_rad(in_air["q_nb"]) > _OVER_RAD) & (in_air["mode"] != Mode.PILOT_OVERRIDE)
        if over.any():
            yield f"agent {agent} turned over at {at_s(float(in_air[tracks.time_field][np.argmax(over)])):.1f} s"
        flies = np.isin(rows["mode"], list(FLOWN_BY_AGENT))
        flown = rows[flies & (rows["phase"] >= Phase.READY) & (rows["phase"] <= Phase.GOTO_LAND)]
        if not len(flown):
            continue
        times_us = flown[tracks.time_field]
        if ground_z_m is None or agent >= tracks.pos_ned_m.shape[1] or not len(tracks.t_us):
            continue
        instants = np.clip(np.searchsorted(tracks.t_us, times_us), 0, len(tracks.t_us) - 1)
        down = tracks.pos_ned_m[instants, agent, 2] > ground_z_m - _CONTACT_M
        down &= np.abs(tracks.t_us[instants] - times_us) < _SAME_INSTANT_US
        if down.any():
            yield f"agent {agent} touched the ground in flight, at {at_s(float(times_us[np.argmax(down)])):.1f} s"
