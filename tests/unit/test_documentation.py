"""Tests that the documentation follows the code: generated pages, quoted files and modules, links."""

from __future__ import annotations

import ast
import importlib.util
import re
import runpy
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest

import swarmctl
from sitl.studies.campaign.trials import SCHEMA
from sitl.studies.sweep.figures import schema_of
from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.configuration.keys import sections
from swarmctl.configuration.sections import SitlParams
from swarmctl.control.controllers.own import GROUP as CONTROLLERS_OFFERED
from swarmctl.control.reference.mission import GROUP as MISSIONS_OFFERED
from swarmctl.core.operator_verbs import OPERATOR_VERBS
from swarmctl.core.recorded.records import PLAN_DTYPE, TICK_DTYPE, TRUTH_DTYPE
from swarmctl.core.types import Phase
from swarmctl.ops.running_launches import LAUNCH_FILE
from swarmctl.ops.supervision.supervisor import ESSENTIAL_ENDED
from swarmctl.telemetry.recording.file_names import CONFIG, EVENTS, OUTCOME, PACKED_TRUTH, RECORDING, SUMMARY
from swarmctl.telemetry.recording.run_files import read_summary
from swarmctl.telemetry.view.viewer import URL_FILE
from tests.benches.recorded_runs import write_configured_run

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
QUOTED = re.compile(r"`([^`\s]+)`")
PACKAGES = "|".join(path.parent.name for path in (ROOT / "swarmctl").glob("*/__init__.py"))
IN_PACKAGE = re.compile(rf"({PACKAGES})(\.[a-z]\w*)+")  # a module by its name within the bridge
TELLS = ("note", "say", "fail", "announce", "event", "tell", "write")  # that tell of an event, by what it is called
NAMES_INSIDE = ("sent", "sent_by", "rejected", "refused_frames")  # of a summary
FOLDERS = ("swarmctl/", "sitl/", "tests/", "tools/", "configs/", "docs/")
_HAS_STATEMENTS = ast.stmt, ast.ExceptHandler, ast.match_case  # expressions, most of a tree, have no docstrings
PLUG_INS = {"swarmctl/control/controllers/", "swarmctl/control/reference/kinds/", "swarmctl/mavlink/dialects/"}


def test_the_page_of_the_configuration_is_what_the_script_writes() -> None:
    written = runpy.run_path(str(ROOT / "tools" / "configuration_page.py"))["page"]()
    assert (ROOT / "docs" / "configuration.md").read_text() == written, "run python tools/configuration_page.py"


def test_the_table_of_columns_is_what_the_script_writes() -> None:
    text = (ROOT / "docs" / "data_formats.md").read_text()
    written = runpy.run_path(str(ROOT / "tools" / "recorded_columns.py"))["page"](text)
    assert text == written, "run python tools/recorded_columns.py"
    assert "| `pos_ned_m` | float64 x 3 | m | reported position | `world/agent/<i>` |\n" in text


def test_every_recorded_column_is_described() -> None:
    recorded = {
        *(TICK_DTYPE.names or ()),
        *(TRUTH_DTYPE.names or ()),
        *(PLAN_DTYPE.names or ()),
        *SCHEMA.names,
        *schema_of([]).names,
    }
    assert recorded - described() == set()


def test_every_event_is_described() -> None:
    code = "".join(path.read_text() for path in (ROOT / "swarmctl").rglob("*.py"))
    calls = (r'\b(?:_?note|_say|_fail|_announce|\w*\.event|log\.write)\(\s*"(\w+)"', r'tell\([^()"]*"(\w+)"')
    events = {event for call in calls for event in re.findall(call, code)}
    assert len(events) > 55
    assert (events | set(ESSENTIAL_ENDED.values())) - described() == set()


def test_every_field_of_an_event_is_described_in_its_row() -> None:
    rows = {event: set(QUOTED.findall(told)) for names, told in event_rows() for event in QUOTED.findall(names)}
    fields = {(event, field) for event, field in told_fields() if event in rows}
    assert len(fields) > 80
    assert {(event, field) for event, field in fields if field not in rows[event]} == set()


def event_rows() -> list[tuple[str, str]]:
    """Return both columns of the table of events."""
    page = (ROOT / "docs" / "data_formats.md").read_text()
    section = page.partition("\n## `events.jsonl`\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| (`.*?) \| (.*) \|$", section, re.MULTILINE)


def told_fields() -> Iterator[tuple[str, str]]:
    """Yield events and their fields, as they are written by name in calls that tell of one."""
    for path in (ROOT / "swarmctl").rglob("*.py"):
        for call in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            if name.strip("_") not in TELLS:
                continue
            events = [each.value for each in call.args[:3] if isinstance(each, ast.Constant)]
            fields = [keyword.arg for keyword in call.keywords if keyword.arg not in (None, "t_us", "utc_us")]
            yield from ((str(event), str(field)) for event in events[:1] for field in fields)


def test_every_key_of_a_summary_is_described(tmp_path: Path) -> None:
    write_configured_run(tmp_path, 2, 8.0)
    page = (ROOT / "docs" / "data_formats.md").read_text()
    section = page.partition("\n## `summary.json`\n")[2].partition("\n## ")[0]
    described_keys = {key for name in QUOTED.findall(section) for key in re.split(r"\W+", name)}
    keys = set(keys_within(read_summary(tmp_path)))
    assert len(keys) > 45
    assert keys - described_keys == set()


def keys_within(value: object) -> Iterator[str]:
    """Yield the keys of objects within a value, but for those that are names of topics, agents or reasons."""
    if isinstance(value, list):
        for item in value:
            yield from keys_within(item)
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            names = () if key not in NAMES_INSIDE else item.values()
            yield from (within for each in names for within in keys_within(each))
            yield from () if key in NAMES_INSIDE else keys_within(item)


def test_every_file_of_a_run_folder_is_described() -> None:
    assert {RECORDING, SUMMARY, EVENTS, OUTCOME, CONFIG, PACKED_TRUTH, LAUNCH_FILE, URL_FILE} - described() == set()


def test_the_height_of_the_simulated_ground_is_told_where_heights_are() -> None:
    ground_z_m = SitlParams().ground_z_m
    tutorial, operating = ((ROOT / "docs" / f"{page}.md").read_text() for page in ("tutorial", "operating"))
    assert f"the simulated ground is at z = {ground_z_m:g} (`sitl.ground_z_m`)" in tutorial
    (row,) = re.findall(r"^\| `alt`, .*$", operating, re.MULTILINE)
    assert f"ground is {ground_z_m:g} m below it (`sitl.ground_z_m`): vehicles on it are at {-ground_z_m:.1f}" in row


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_extras_that_are_to_be_installed_exist(page: Path) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    told = re.findall(r"pip install[^`\n]*?'(?:\.|swarmctl)\[([\w,]+)\]'", page.read_text())
    assert {extra for extras_told in told for extra in extras_told.split(",")} <= extras.keys()
    assert page.name != "python_api.md" or told == ["pandas"]


def test_the_table_of_orders_and_phases_is_that_of_the_code() -> None:
    page = (ROOT / "docs" / "operating.md").read_text()
    phases = [phase.name for phase in Phase]
    assert f"| order | {' | '.join(phases)} |\n" in page
    for name, verb in OPERATOR_VERBS.items():
        obeyed = ["yes" if phase in verb.phases else "-" for phase in phases]
        assert f"| `{name}` | {' | '.join(obeyed)} |\n" in page


def described() -> set[str]:
    """Return the names in the first column of the tables of data formats."""
    page = (ROOT / "docs" / "data_formats.md").read_text()
    return {name for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for name in QUOTED.findall(row)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_quoted_files_and_modules_exist(page: Path) -> None:
    missing = [name for name in QUOTED.findall(page.read_text()) if is_ours(name) and not exists(name)]
    assert missing == []


def test_files_and_modules_that_docstrings_quote_exist() -> None:
    keys = {key.path for section in sections() for key in section.keys}
    missing = set()
    for path in (path for folder in ("swarmctl", "sitl", "tests", "tools") for path in (ROOT / folder).rglob("*.py")):
        source = path.read_text()
        if not QUOTED.search(source):
            continue
        quoted = {name for text in docstrings(source) for name in QUOTED.findall(text)} - keys - {RECORDING}
        names = {f"swarmctl.{name}" if IN_PACKAGE.fullmatch(name) else name for name in quoted}
        missing |= {(path.name, name) for name in names if is_ours(name) and not (exists(name) or is_in_module(name))}
    assert missing == set()


def docstrings(source: str) -> Iterator[str]:
    """Yield the docstrings of a module, its classes and functions."""
    nodes: list[ast.AST] = [ast.parse(source)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""
        nodes += (child for child in ast.iter_child_nodes(node) if isinstance(child, _HAS_STATEMENTS))


def is_in_module(name: str) -> bool:
    """Return whether this is a class, function or constant of a module."""
    module, _, member = name.rpartition(".")
    return is_module(module) and hasattr(importlib.import_module(module), member)


def test_what_troubleshooting_quotes_is_said_by_the_code() -> None:
    code = "".join(path.read_text() for folder in ("swarmctl", "sitl") for path in (ROOT / folder).rglob("*.py"))
    said = re.sub(r"\{[^{}]*\}", "...", re.sub(r'"\s*\n\s*f?"', "", code))  # literals on several lines are one
    rows = re.findall(r"^\| (`.*?`.*?) \|", (ROOT / "docs" / "troubleshooting.md").read_text(), re.MULTILINE)
    quoted = [text for row in rows for text in re.findall(r"`([^`]+)`", row)]
    assert len(quoted) > 30
    parts = {part.strip(" ().") for text in quoted for part in re.split(r"\.\.\.", text)}
    unsaid = {part for part in parts if len(part) > 3 and part not in said}
    assert unsaid == set(), "texts of the program have changed: follow them in docs/troubleshooting.md"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


def test_every_key_of_a_status_is_described() -> None:
    page = (ROOT / "docs" / "data_formats.md").read_text()
    section = page.partition("\n## `status --json`\n")[2].partition("\n## ")[0]
    keys = {key for row in re.findall(r"^\| (`[^|]+`) \|", section, re.MULTILINE) for key in QUOTED.findall(row)}
    assert keys - {"key"} == set(StatusMessage.__struct_fields__)


def test_the_page_of_the_architecture_names_every_module() -> None:
    """Each in the row of its folder, or in one of its own; modules that are found by being there need none."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = set()
    for where, what in re.findall(r"^\| (.*?) \| (.*) \|$", page, re.MULTILINE):
        places, names = QUOTED.findall(where), QUOTED.findall(what)
        named |= {*places, *(f"{place}{name}" for place in places if place.endswith("/") for name in names)}
    paths = [path.relative_to(ROOT) for folder in ("swarmctl", "sitl") for path in (ROOT / folder).rglob("*.py")]
    modules = {str(path) for path in paths if path.name != "__init__.py" and f"{path.parent}/" not in PLUG_INS}
    assert len(modules) > 300
    assert modules - named == set()


def test_the_table_of_tools_names_every_tool() -> None:
    page = (ROOT / "docs" / "extending.md").read_text()
    tools = {f"tools/{path.name}" for path in (ROOT / "tools").glob("*.py")}
    assert tools - set(re.findall(r"^\| `(tools/\w+\.py)` \|", page, re.MULTILINE)) == set()


def is_ours(name: str) -> bool:
    if name in (CONTROLLERS_OFFERED, MISSIONS_OFFERED):
        return False
    return name.endswith(".py") or name.startswith(FOLDERS) or re.match(r"(swarmctl|sitl)\.[a-z]", name) is not None


def exists(name: str) -> bool:
    """Return whether a path, pattern or dotted module of the tree exists; a name without a folder may be anywhere."""
    if re.match(r"(swarmctl|sitl)(\.\w+)+$", name) and not name.endswith(".py"):
        return (
            is_module(name)
            or is_for_scripts(name)
            or name.removeprefix("sitl.").partition(".")[0] in SitlParams.model_fields
        )
    return any(ROOT.glob(name.rstrip("/"))) or ("/" not in name and any(fnmatch(file, name) for file in file_names()))


@cache
def file_names() -> frozenset[str]:
    """Return the names of all files of the tree, without environments and the like, which are hidden."""
    folders = (folder for folder in ROOT.iterdir() if folder.is_dir() and not folder.name.startswith("."))
    return frozenset(path.name for folder in folders for path in folder.rglob("*"))


def is_for_scripts(name: str) -> bool:
    """Return whether this is a name that the package itself offers, as `swarmctl.load`."""
    return name.removeprefix("swarmctl.") in dir(swarmctl)


def is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False
