"""Mesh of a small quadrotor as binary glTF, in FRD [m]: front rotors in the agent's colour, rear ones dark."""

from __future__ import annotations

import json
import struct

import numpy as np
from numpy.typing import NDArray

_ARM_M = 0.17  # distance from the centre to a rotor
_ROTOR_M = 0.095
_DARK = (0.13, 0.15, 0.19)
_GREY = (0.42, 0.46, 0.52)

Triangles = NDArray[np.float32]  # (T, 3 corners, 3) FRD [m]
Color = tuple[float, float, float]  # linear RGB in 0..1


def quad_glb(rgb: tuple[int, int, int]) -> bytes:
    """Return the bytes of the mesh for an agent of colour `rgb` (0..255)."""
    r, g, b = (float((c / 255) ** 2.2) for c in rgb)
    accent = (r, g, b)
    arms = np.concatenate([_box((0.0, 0.0, 0.0), (_ARM_M, 0.009, 0.008), yaw) for yaw in (np.pi / 4, -np.pi / 4)])
    side = _ARM_M / np.sqrt(2)
    front = np.concatenate([_disk((side, y, -0.03), _ROTOR_M) for y in (side, -side)])
    rear = np.concatenate([_disk((-side, y, -0.03), _ROTOR_M) for y in (side, -side)])
    motors = np.concatenate(
        [_box((x, y, -0.012), (0.016, 0.016, 0.02), 0.0) for x in (side, -side) for y in (side, -side)]
    )
    hull = _box((0.0, 0.0, -0.005), (0.07, 0.04, 0.024), 0.0)
    nose = _box((0.075, 0.0, -0.008), (0.014, 0.018, 0.012), 0.0)
    parts = [(arms, _GREY), (hull, accent), (motors, _DARK), (front, accent), (rear, _DARK), (nose, (0.9, 0.9, 0.9))]
    return _glb(parts)


def _box(center_m: tuple[float, float, float], half_m: tuple[float, float, float], yaw_rad: float) -> Triangles:
    faces = []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for side in (1.0, -1.0):
            normal = side * np.eye(3)[axis]
            corners = [normal + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            order = corners if side > 0 else corners[::-1]
            faces += [order[:3], [order[0], order[2], order[3]]]
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    triangles: Triangles = (np.array(faces) * half_m @ turn.T + center_m).astype(np.float32)
    return triangles


def _disk(center_m: tuple[float, float, float], radius_m: float, sides: int = 24) -> Triangles:
    angle = np.linspace(0.0, 2 * np.pi, sides + 1)
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides + 1)]) * radius_m + center_m
    top = [(center_m, rim[k + 1], rim[k]) for k in range(sides)]
    bottom = [(center_m, rim[k], rim[k + 1]) for k in range(sides)]
    return np.array([*top, *bottom], dtype=np.float32)


def _glb(parts: list[tuple[Triangles, Color]]) -> bytes:
    blob = b""
    views, accessors, primitives, materials = [], [], [], []
    for number, (triangles, color) in enumerate(parts):
        corners = np.ascontiguousarray(triangles.reshape(-1, 3), "<f4")
        flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        normals = np.ascontiguousarray(np.repeat(flat, 3, axis=0), "<f4")
        indices = np.arange(len(corners), dtype="<u4")
        for data, kind, component in ((corners, "VEC3", 5126), (normals, "VEC3", 5126), (indices, "SCALAR", 5125)):
            views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": data.nbytes})
            accessor = {"bufferView": len(views) - 1, "componentType": component, "count": len(data), "type": kind}
            if data is corners:
                accessor |= {"min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist()}
            accessors.append(accessor)
            blob += data.tobytes()
        first = 3 * number
        attributes = {"POSITION": first, "NORMAL": first + 1}
        primitives.append({"attributes": attributes, "indices": first + 2, "material": number})
        surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
        materials.append({"pbrMetallicRoughness": surface})
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
