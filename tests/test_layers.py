"""The nine rooms of flockd, each standing on those below it, and what stays pure."""

from __future__ import annotations

import ast
import inspect
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "flockd"

ROOMS = ("core", "flight", "onboard", "fleet", "ground", "review", "sim", "campaign", "cli")
"""From the ground up: a room imports itself and rooms below it."""
FLIGHT = ("geometry", "inference", "tracking", "perception", "safety", "flocking", "obstacles", "mission", "pilot")
"""The order inside `flight`. Flocking, obstacles and mission ask for the half planes and the fence of safety."""
ONBOARD = ("autopilot", "telemetry", "sources", "recording", "daemon")
"""The order inside `onboard`: frames may come over zenoh; recording asks telemetry for the table of topics."""

PURE_ROOMS = ("flight", "core/messages.py", "core/choices.py")
"""No clock, no socket, no thread, no environment: what is tested is what flies."""
IMPURE_MODULES = {
    "asyncio", "threading", "multiprocessing", "concurrent", "time", "datetime", "socket", "zenoh", "random"
}  # fmt: skip
SIMULATION = ("sim", "campaign", "review/report")
"""Only the simulator, campaigns and reports may need the libraries of the extra `sim`."""
LIBRARIES = {
    "onnxruntime openvino": ("flight/inference",),
    "mavsdk": ("onboard/autopilot/mavsdk_link.py",),
    "pymavlink": ("sim/autopilot", "sim/sitl/ground_station.py"),
    "joblib": ("campaign/engine.py",),
    "rosbags": ("review/replay/bag_flight.py",),
    "rclpy": ("fleet/ros/ros_node.py", "onboard/sources/camera_child.py"),
    "onnx": ("ground/detector_import.py",),
    "numba": SIMULATION,
    "matplotlib": SIMULATION,
    "jinja2 markupsafe": SIMULATION,
}
"""Where outside libraries sit behind their adapters."""
TOOL_LIBRARIES = {"torch", "trimesh", "embreex", "pytest"}
"""For training and tests: nothing in the package may need them."""


@cache
def _imports(path: Path) -> frozenset[str]:
    """All modules that a file imports, anywhere in it; `from a.b import c` counts as `a.b` and `a.b.c`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write it in full"
            assert node.module is not None
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


def _place(path: Path) -> tuple[str, ...]:
    """The room, and what is in it: ("flight", "safety", "gate")."""
    return path.relative_to(PACKAGE).with_suffix("").parts


def _room(path: Path) -> str:
    return _place(path)[0]


def taken(path: Path) -> list[list[str]]:
    """The modules of flockd that a file imports, without `flockd`: ["flight", "safety", "gate"]."""
    return [name.split(".")[1:] for name in _imports(path) if name.startswith("flockd.") and "__version__" not in name]


def _libraries(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in _imports(path)}


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)


def _of(*places: str) -> list[Path]:
    """The modules of rooms, folders or files; every place has to be there."""
    found = [path for place in places for path in MODULES if path.is_relative_to(PACKAGE / place)]
    assert all((PACKAGE / place).exists() for place in places)
    return found


def test_there_are_nine_rooms() -> None:
    assert {_room(path) for path in MODULES} == set(ROOMS)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_below_it(room: str) -> None:
    below = ROOMS[: ROOMS.index(room) + 1]
    for path in _of(room):
        assert {names[0] for names in taken(path)} <= set(below), path


@pytest.mark.parametrize(("room", "order"), [("flight", FLIGHT), ("onboard", ONBOARD)])
def test_what_flies_stands_in_one_order(room: str, order: tuple[str, ...]) -> None:
    for path in _of(*(f"{room}/{folder}" for folder in order)):
        below = set(order[: order.index(_place(path)[1]) + 1])
        used = {names[1] for names in taken(path) if names[0] == room and len(names) > 1}
        assert used & set(order) <= below, path


def test_the_bridge_to_ros_knows_no_page() -> None:
    for path in set(_of("fleet")) - set(_of("fleet/page")):
        assert not any(names[:2] == ["fleet", "page"] for names in taken(path)), path


def test_the_pure_line_knows_no_clock_no_thread_and_no_network() -> None:
    for path in _of(*PURE_ROOMS):
        assert not _libraries(path) & IMPURE_MODULES, path
        assert "environ" not in path.read_text(encoding="utf-8"), path
        assert "getenv" not in path.read_text(encoding="utf-8"), path


def test_only_the_gate_makes_a_setpoint() -> None:
    """What is asked for and what is allowed are two types; a name is followed under an import's other name too."""
    for path in MODULES:
        if "Setpoint" not in (text := path.read_text(encoding="utf-8")):
            continue
        tree = ast.parse(text)
        names = {"Setpoint"} | {
            alias.asname
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if alias.name == "Setpoint" and alias.asname
        }
        called = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        makes = any(ast.unparse(function).rpartition(".")[2] in names for function in called)
        assert makes == (_place(path) == ("flight", "safety", "gate")), path


ZENOH_SESSION = PACKAGE / "onboard" / "telemetry" / "zenoh_session.py"
"""Opens and closes sessions, whatever goes through them."""
FRAMES_OVER_ZENOH = PACKAGE / "onboard" / "sources" / "shared_memory.py"
"""A drone's own camera frames may come over zenoh, under keys that no telemetry has."""
ZENOH_READERS = {
    "declare_subscriber": {FRAMES_OVER_ZENOH, PACKAGE / "fleet" / "watcher.py"},
    "declare_queryable": {PACKAGE / "onboard" / "telemetry" / "publisher.py"},
    "declare_querier": set[Path](),
}
"""Replies to queries; what an operator may ask says nothing of where another drone is."""


@pytest.mark.parametrize("libraries", LIBRARIES)
def test_an_outside_library_sits_behind_its_adapters(libraries: str) -> None:
    users = {path for path in MODULES if {*libraries.split()} & _libraries(path)}
    assert users
    assert users <= set(_of(*LIBRARIES[libraries]))


def test_no_module_needs_what_is_for_training_and_tests() -> None:
    for path in MODULES:
        assert not _libraries(path) & TOOL_LIBRARIES, path


def test_no_drone_reads_telemetry_to_fly() -> None:
    """Telemetry can be published; to read it is for people, in `fleet`, which nothing that flies imports."""
    from flockd.onboard.sources import shared_memory
    from flockd.onboard.telemetry.topics import PREFIX

    assert not shared_memory.PREFIX.startswith(f"{PREFIX.split('/')[0]}/")
    for path in MODULES:
        if path not in {FRAMES_OVER_ZENOH, *_of("onboard/telemetry", "fleet")}:
            assert "zenoh" not in _libraries(path), path
        text = path.read_text(encoding="utf-8")
        for word, allowed in ZENOH_READERS.items():
            assert word not in text or path in allowed, path


def test_one_file_opens_and_closes_sessions() -> None:
    for path in (path for path in MODULES if "zenoh" in _libraries(path) and path != ZENOH_SESSION):
        text = path.read_text(encoding="utf-8")
        assert "zenoh.open" not in text, path
        assert "zenoh.Config" not in text, path
        assert "session.close" not in text, path


def test_no_drone_gets_the_truth() -> None:
    """A simulator records where everybody truly is, for those who examine recordings; a pilot gets its own senses."""
    from flockd.flight.pilot import FlockPilot

    for path in set(MODULES) - set(_of("sim", "onboard/recording", "review")):
        assert "flockd.onboard.recording.truth" not in _imports(path), path
    assert list(inspect.signature(FlockPilot.step).parameters) == ["self", "frames", "vehicle", "trace", "order"]


def test_the_doctor_sees_of_the_daemon_what_everybody_sees() -> None:
    import flockd.onboard.daemon

    name = "flockd.onboard.daemon"
    public = {name, *(f"{name}.{part}" for part in flockd.onboard.daemon.__all__)}
    for path in _of("ground/doctor"):
        assert {taken for taken in _imports(path) if taken.startswith(name)} <= public, path


FILES_OF_ONE_NAME = {
    "__init__.py": "marks a package",
    "errors.py": "the error types of its folder",
    "avoidance.py": "the section of the configuration for obstacles, and what flies around them",
    "rig.py": "the rig's section of the configuration, and the rig built from it",
}
"""Names that several files of the package may share, and why."""


def test_no_two_files_have_one_name_and_different_meaning() -> None:
    names = Counter(path.name for path in MODULES if _room(path) != "cli")
    assert {name for name, count in names.items() if count > 1} <= FILES_OF_ONE_NAME.keys()
