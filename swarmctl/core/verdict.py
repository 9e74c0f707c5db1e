"""The severity of what a check finds."""

from __future__ import annotations

import enum


class Verdict(enum.IntEnum):
    """Severity of a finding; that of a check is the largest of its findings."""

    OK = 0
    NOTE = 1  # worth knowing; the vehicle can fly
    FIX = 2  # the vehicle can't fly, or not safely
