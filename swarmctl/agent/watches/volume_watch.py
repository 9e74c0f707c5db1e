"""Tells when a vehicle is found outside of the flight volume, and when it is back."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import VehicleState


class VolumeWatch:
    """Reports every stay outside of the volume, while the agent decides where its vehicle flies.

    Args:
        volume: None for none.
        note: is told `outside_volume`, with `begins=True, face=..., beyond_m=...` when one begins, and at its end with
            `begins=False, lasted_s=..., worst_m=...`.
    """

    def __init__(self, volume: FlightVolume | None, note: Callable[..., None]) -> None:
        self._volume, self._note = volume, note
        self._since_us: int | None = None
        self._worst_m = 0.0

    def update(self, now_us: int, state: VehicleState, flies: bool) -> str:
        """Take in a tick in which the agent flies, or does not; returns the text of an alert, or ""."""
        if self._volume is None:
            return ""
        beyond_m = float(self._volume.beyond_m(state.pos_ned_m)) if flies else 0.0
        if beyond_m <= 0.0:
            if self._since_us is not None:
                lasted_s = (now_us - self._since_us) * 1e-6
                self._note("outside_volume", begins=False, lasted_s=lasted_s, worst_m=self._worst_m)
                self._since_us, self._worst_m = None, 0.0
            return ""
        face = self._volume.face(state.pos_ned_m)
        if self._since_us is None:
            self._since_us = now_us
            self._note("outside_volume", begins=True, face=face, beyond_m=beyond_m)
        self._worst_m = max(self._worst_m, beyond_m)
        return f"{beyond_m:.1f} m outside of the flight volume ({face}): comes back"
