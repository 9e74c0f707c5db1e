"""Mesh of a small quadrotor as binary glTF, in FRD [m]: front rotors in the agent's colour, rear ones dark."""

from __future__ import annotations

from pathlib import Path

_MESH = Path(__file__).with_name("assets") / "quad.glb"
_ANY_COLOR = b"[0.11111,0.22222,0.33333,"  # in the file; what replaces it is as long, so that lengths stay valid


def quad_glb(rgb: tuple[int, int, int]) -> bytes:
    """Return the bytes of the mesh for an agent of colour `rgb` (0..255)."""
    color = b"[%.5f,%.5f,%.5f," % tuple((c / 255) ** 2.2 for c in rgb)  # linear
    return _MESH.read_bytes().replace(_ANY_COLOR, color)
