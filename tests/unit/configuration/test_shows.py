"""Shows of Skybrush: read once, flown along their Bezier curves, and refused with all that is wrong with them."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarmctl.config import Config, dump, load
from swarmctl.core.types import Array
from swarmctl.errors import ConfigError

CURVED: list[Any] = [  # of one velocity where two curves meet, and at rest at both ends
    [0.0, [0.0, 0.0, 2.0], []],
    [2.0, [1.5, 0.5, 3.0], [[0.0, 0.0, 2.0], [1.1, 0.3, 3.0]]],
    [5.0, [3.0, 2.0, 3.0], [[1.86, 0.68, 3.0], [2.3, 1.2, 3.0], [3.0, 2.0, 3.0], [3.0, 2.0, 3.0]]],
    [7.0, [3.0, 2.0, 3.0], []],
]
HOVERING: list[Any] = [[0.0, [0.0, 20.0, 2.0]]]
FAR: list[Any] = [
    [1.0, [0.0, 20.0, 2.0]],
    [9.0, [0.0, 24.0, 2.0], None],
]  # no control points, said twice


def drone(points: Any, **more: Any) -> dict[str, Any]:
    return {"type": "generic", "settings": {"trajectory": {"version": 1, "points": points, **more}}}


def referring(name: str) -> dict[str, Any]:
    return {"type": "generic", "settings": {"trajectory": {"$ref": name}}}


def show_of(*drones: Any) -> dict[str, Any]:
    return {"version": 1, "settings": {"cues": []}, "swarm": {"drones": list(drones)}}


def config_with(folder: Path, files: Mapping[str, Any], agents: int = 2, more: str = "") -> Path:
    """Write an archive with these files, JSON or bytes, and a configuration that flies it."""
    with zipfile.ZipFile(folder / "show.skyc", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content if isinstance(content, bytes) else json.dumps(content))
    path = folder / "own.toml"
    path.write_text(
        f'[swarm]\nagents = {agents}\n[start]\nspacing_m = 10.0\n[mission]\nkind = "skybrush"\nduration_s = 5.0\n'
        f'[mission.skybrush]\nfile = "show.skyc"\n{more}'
    )
    return path


def flown(config: Config, agent: int, t_s: Array) -> tuple[Array, Array]:
    reference = config.mission.references(np.array(config.starts_ned_m()), 1.0)[agent]
    return reference.sample(t_s)


def de_casteljau(points: list[list[float]], at_01: float) -> Array:
    curve: Array = np.array(points)
    while len(curve) > 1:
        curve = (1.0 - at_01) * curve[:-1] + at_01 * curve[1:]
    there: Array = curve[0]
    return there


def test_a_show_is_flown_along_its_curves_in_metres_with_z_up(tmp_path: Path) -> None:
    more = "origin_ned_m = [100.0, 0.0, 0.5]\nbegin_s = 1.5\n"
    drones = (drone(CURVED, takeoffTime=1.5), referring("./drones/drone%202/trajectory.json#"))
    files = {"show.json": show_of(*drones), "drones/drone 2/trajectory.json": {"version": 1, "points": FAR}}
    path = config_with(tmp_path, files, more=more)
    config = load(path)
    t_s = np.arange(0.0, 7.0, 0.05) + 0.01
    pos, vel = flown(config, 0, t_s)
    for at_s, here, speed in zip(t_s, pos, vel, strict=True):
        i = next(i for i in range(1, 4) if at_s < CURVED[i][0])
        (begin_s, first, _), (end_s, last, controls) = CURVED[i - 1], CURVED[i]
        expected, ahead = (
            de_casteljau([first, *controls, last], (at_s + dt_s - begin_s) / (end_s - begin_s)) for dt_s in (0.0, 1e-6)
        )
        assert here == pytest.approx([100.0 + expected[0], -expected[1], 0.5 - expected[2]], abs=1e-9)
        along = (ahead - expected) * 1e6
        assert speed == pytest.approx([along[0], -along[1], -along[2]], abs=1e-4)
    other, _ = flown(config, 1, np.array([0.0, 3.5, 100.0]))
    assert other[:, 1] == pytest.approx([-20.25, -22.0, -24.0]), "it began half a second before; it stays at its end"
    resolved = tmp_path / "elsewhere" / "config.toml"
    resolved.parent.mkdir()
    resolved.write_text(dump(config))
    (tmp_path / "show.skyc").unlink()
    assert load(resolved) == config, "a run folder needs no other file"


def test_before_its_take_off_a_drone_waits_where_it_begins(tmp_path: Path) -> None:
    config = load(config_with(tmp_path, {"show.json": show_of(drone(CURVED, takeoffTime=3.0), drone(HOVERING))}))
    pos, vel = flown(config, 0, np.array([0.0, 2.9]))
    assert pos == pytest.approx(np.array([[0.0, 0.0, -2.0]] * 2))
    assert vel == pytest.approx(np.zeros((2, 3)))


def test_trajectories_that_come_too_close_are_refused_before_the_flight(tmp_path: Path) -> None:
    def beside(place: list[float]) -> list[float]:
        return [place[0], place[1] + 0.4, place[2]]

    near = [[t, beside(place), [beside(control) for control in controls]] for t, place, controls in CURVED]
    with pytest.raises(ConfigError, match=r"agents 0 and 1: at 0.00 s the references are 0.40 m apart"):
        load(config_with(tmp_path, {"show.json": show_of(drone(CURVED), drone(near))}))


def test_all_that_is_wrong_with_a_show_is_said_at_once(tmp_path: Path) -> None:
    drones: tuple[Any, ...] = (
        drone([[0.0, [0, 0, 2.0], []], ["x", [0, 0, 2.0], []], [3.0, [0, 0], []], [4.0, [0, 0, 1e999], []]]),
        {"settings": {}},
        {"settings": {"trajectory": {"version": 2, "points": []}}},
        referring("../../etc/passwd"),
        referring("http://example.org/a.json"),
        referring("drones/nothing.json"),
        drone(FAR, takeoffTime=-1.0),
    )
    show = json.dumps(show_of(*drones)).replace("Infinity", "1e999").encode()
    with pytest.raises(ConfigError) as caught:
        load(config_with(tmp_path, {"show.json": show}))
    said = [problem.removeprefix("mission.skybrush.file: show.skyc: ") for problem in caught.value.problems]
    assert [problem.split(";")[0] for problem in said] == [
        "drone 0: point 1: ['x', [0, 0, 2.0], []]",
        "drone 0: point 2: [3.0, [0, 0], []]",
        "drone 0: point 3: [4.0, [0, 0, inf], []]",
        "drone 1: settings.trajectory: missing",
        "drone 2: trajectory: version 2",
        "drone 2: points: missing",
        "$ref '../../etc/passwd': only whole files of the archive are read",
        "drone 3: settings.trajectory: missing",
        "$ref 'http://example.org/a.json': only whole files of the archive are read",
        "drone 4: settings.trajectory: missing",
        "drones/nothing.json: is not in the archive",
        "drone 5: settings.trajectory: missing",
        "drone 6: takeoffTime = -1.0: a time from 0 s on",
    ]


def test_points_that_make_no_flight_are_refused_with_their_numbers(tmp_path: Path) -> None:
    backwards = [[0.0, [0, 0, 2], [[0, 0, 2]]], [2.0, [0, 0, 3], []], [2.0, [0, 0, 3], []], [1.0, [0, 0, 3], []]]
    many = [[0.0, [0, 9, 2]], [2.0, [0, 9, 3], [[0, 9, 2]] * 7]]
    with pytest.raises(ConfigError) as caught:
        load(config_with(tmp_path, {"show.json": show_of(drone(backwards), drone(many), drone(FAR))}))
    assert caught.value.problems == (
        "mission.skybrush.file: a show of 3 drones for swarm.agents = 2",
        "mission.skybrush: drone 0: point 0: 1 control points; nothing leads to the first point",
        "mission.skybrush: drone 0: point 2: t = 2 after 2; times must increase",
        "mission.skybrush: drone 0: point 3: t = 1 after 2; times must increase",
        "mission.skybrush: drone 1: point 1: 7 control points; at most 6 are flown",
    )


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"other.json": {}}, "show.json: is not in the archive"),
        ({"show.json": b"{"}, "show.json: Expecting property name"),
        ({"show.json": b'{"version": NaN}'}, "NaN is no number of JSON"),
        ({"show.json": b"[" * 100_000}, "show.json: nested too deeply"),
        ({"show.json": b"[]"}, "show.json: version None; 1 is read"),
        ({"show.json": b"\xff\xfe\x00"}, "show.json: "),
        ({"show.json": b" " * 60_000_000}, "is longer than 50000000 bytes"),
        ({"show.json": show_of(drone([[float(t), [0, 0, 2]] for t in range(20_001)]))}, "at most 20000 of all drones"),
    ],
    ids=["no show", "no JSON", "NaN", "deep", "a list", "not text", "a bomb", "too many points"],
)
def test_what_is_no_show_is_refused(tmp_path: Path, files: Mapping[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(config_with(tmp_path, files))
    assert words in str(caught.value)
    assert "mission.skybrush.file: show.skyc" in str(caught.value)


def test_a_file_that_is_no_archive_or_damaged_is_refused(tmp_path: Path) -> None:
    path = config_with(tmp_path, {"show.json": show_of(drone(CURVED), drone(HOVERING))})
    content = (tmp_path / "show.skyc").read_bytes()
    damaged = bytearray(content)
    damaged[60:90] = bytes(30)
    for wrong, words in ((b"no archive", "is no ZIP archive"), (bytes(damaged), "show.json: ")):
        (tmp_path / "show.skyc").write_bytes(wrong)
        with pytest.raises(ConfigError, match=words):
            load(path)
    (tmp_path / "show.skyc").unlink()
    with pytest.raises(ConfigError, match="no such file"):
        load(path)


def test_an_archive_of_a_later_kind_is_refused(tmp_path: Path) -> None:
    """Found by tools/fuzz.py: a byte of the directory names a version that the library does not read."""
    path = config_with(tmp_path, {"show.json": show_of(drone(HOVERING), drone(FAR))})
    archive = tmp_path / "show.skyc"
    content = bytearray(archive.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 6] = 84  # version needed to extract, in the directory
    archive.write_bytes(content)
    with pytest.raises(ConfigError, match="is no ZIP archive"):
        load(path)
