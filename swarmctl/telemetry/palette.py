"""Colours of agents, phases and modes, shared by live view, recording and report; readable on dark and on white."""

from __future__ import annotations

import colorsys

_AGENTS = (  # any two are at least 0.11 apart in OKLab, also from the red of limits and the grey of references
    (59, 130, 246),  # blue
    (245, 158, 11),  # amber
    (16, 185, 129),  # emerald
    (217, 70, 239),  # fuchsia
    (180, 90, 105),  # garnet
    (225, 165, 210),  # orchid
    (15, 195, 255),  # sky
    (135, 120, 0),  # olive
    (255, 0, 150),  # pink
    (0, 150, 0),  # green
    (0, 210, 0),  # lime
    (180, 135, 255),  # lavender
    (165, 165, 0),  # mustard
    (150, 75, 255),  # violet
    (165, 195, 150),  # sage
    (255, 120, 135),  # coral
    (195, 135, 90),  # copper
    (150, 105, 180),  # plum
    (255, 120, 240),  # rose
    (30, 135, 105),  # pine
)

LIMIT_RGB = (239, 68, 68)  # limits, obstacles and violations; used by no agent
REFERENCE_RGB = (148, 163, 184)
SUM_RGB = (100, 116, 139)
NUMBER_RGB = (241, 245, 249)  # texts in the dark scene
SPARE_RGB = ((45, 212, 191), (226, 232, 240))  # second and third curve beside an agent's own

PHASE_RGB = {
    "CONNECT": (71, 85, 105),
    "STANDBY": (100, 116, 139),
    "ARM": (202, 138, 4),
    "TAKEOFF": (14, 165, 233),
    "GOTO_START": (56, 189, 248),
    "READY": (45, 212, 191),
    "TRACK": (34, 160, 90),
    "GOTO_LAND": (129, 140, 248),
    "LAND": (99, 102, 241),
    "DONE": (71, 85, 105),
}

MODE_RGB = {
    "IDLE": (71, 85, 105),
    "PRIMING": (14, 165, 233),
    "TRACKING": (34, 160, 90),
    "REPLAY": (234, 179, 8),
    "BRAKE": (249, 115, 22),
    "HOLD": (45, 212, 191),
    "LAND": (99, 102, 241),
    "PILOT_OVERRIDE": (168, 85, 247),
    "STATE_STALE": (220, 38, 38),
}

CONTROL_RGB = {
    **{name: MODE_RGB[name] for name in ("PRIMING", "TRACKING", "REPLAY", "BRAKE", "HOLD")},
    "AUTO": MODE_RGB["IDLE"],
    "GOTO": (236, 72, 153),
    "WAIT": (202, 138, 4),
    "RETURN": (163, 230, 53),
    "RTL": (129, 140, 248),
    "LANDING": MODE_RGB["LAND"],
    "PILOT": MODE_RGB["PILOT_OVERRIDE"],
    "FAILSAFE": (190, 18, 60),
    "LOST": MODE_RGB["STATE_STALE"],
}

PLAN_RGB = {
    "OK": (34, 160, 90),
    "SOLVER_FAILED": (220, 38, 38),
    "RESIDUAL": (249, 115, 22),
    "NOT_CERTIFIED": (234, 179, 8),
    "NONE": (71, 85, 105),
}


def agent_rgb(agent: int) -> tuple[int, int, int]:
    """Return the colour of an agent, (r, g, b) in 0..255; beyond the table hues advance by the golden ratio."""
    if agent < len(_AGENTS):
        return _AGENTS[agent]
    r, g, b = colorsys.hsv_to_rgb((0.61803398875 * agent) % 1.0, 0.65, 0.85)
    return round(r * 255), round(g * 255), round(b * 255)


def lighter(rgb: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a colour half way to white."""
    r, g, b = ((255 + part) // 2 for part in rgb)
    return r, g, b


def css(rgb: tuple[int, int, int]) -> str:
    """Return a colour as `#rrggbb`."""
    return f"#{rgb[0]:02x}{rgb[1]:02x}{rgb[2]:02x}"
