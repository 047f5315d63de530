"""The folders of flockd keep to their places: who may import whom, and what stays pure."""

from __future__ import annotations

import ast
import inspect
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "flockd"

BASE = {"choices", "messages", "config", "errors", "data", "earth", "printable"}
"""Under everything: choices, nouns, the typed configuration, error types, the shipped files, how large a degree is,
texts for a terminal."""

MAY_IMPORT = {
    "choices": set(),
    "messages": set(),
    "errors": set(),
    "data": {"errors"},
    "earth": set(),
    "image_header": set(),
    "preview": BASE | {"geometry"},
    "printable": set(),
    "zenoh_session": {"errors"},
    "side_process": {"errors"},
    "config": {"choices", "messages", "errors"},
    "geometry": BASE,
    "inference": BASE,
    "perception": BASE | {"geometry", "inference", "tracking"},
    "tracking": BASE | {"geometry"},
    "flocking": BASE,
    "safety": BASE,
    "mission": BASE | {"safety"},  # for the fence
    "obstacles": BASE | {"safety", "flocking"},
    "worlds": BASE,
    "control_level": BASE | {"flocking", "mission", "obstacles", "safety", "worlds"},  # neither renderer nor networks
    "pilot": BASE
    | {"obstacles"}
    | {"geometry", "inference", "perception", "tracking", "flocking", "safety", "mission"},
    "sources": BASE | {"zenoh_session", "image_header"},
    "cameras": BASE | {"sources"},
    "autopilot": BASE,
    "telemetry": BASE | {"zenoh_session"},
    "recording": BASE
    | {"geometry", "telemetry", "image_header"},  # telemetry for the table of topics, which says what is recorded
    "flight_log": BASE | {"geometry", "flocking", "mission", "perception", "pilot", "recording"},
    "pictures": BASE | {"geometry", "inference", "perception", "datasets", "image_header"},
    "calibration": BASE | {"geometry", "recording", "datasets", "sources", "perception", "pictures"},
    "datasets": BASE | {"geometry", "image_header"},
    "replay": BASE | {"geometry", "inference", "perception", "pilot", "recording", "datasets"},
    "sim": BASE
    | {
        "geometry",
        "inference",
        "perception",
        "tracking",
        "flocking",
        "mission",
        "obstacles",
        "safety",
        "pilot",
        "telemetry",
        "recording",
        "flight_log",
        "side_process",
        "worlds",
    }
    | {"sources", "autopilot"},  # real daemons are fed frames and given autopilots
    "report": BASE | {"flocking", "flight_log", "side_process"},
    "campaign": BASE | {"inference", "flocking", "flight_log", "side_process", "sim", "control_level", "report"},
    "view": BASE | {"geometry", "perception", "pilot", "recording"},
    "fleet_page": BASE | {"geometry", "preview", "telemetry", "recording"},
    "foxglove_server": BASE
    | {"geometry", "preview", "image_header", "telemetry", "recording", "fleet_page"},  # the page has the fleet's rows
    "daemon": BASE
    | {"obstacles", "preview"}
    | {"geometry", "inference", "perception", "pilot", "safety", "sources", "autopilot", "telemetry", "recording"}
    | {"mission"},
    "doctor": BASE
    | {"geometry", "inference", "perception", "pilot", "sources", "cameras", "autopilot", "telemetry", "daemon"},
    "cli": BASE
    | {
        "inference",
        "perception",
        "pilot",
        "telemetry",
        "recording",
        "flight_log",
        "datasets",
        "replay",
        "sim",
        "report",
        "campaign",
        "view",
        "daemon",
        "doctor",
        "fleet_page",
        "foxglove_server",
    }
    | {"calibration", "geometry", "sources", "cameras", "pictures"},
}
"""What each folder may import of the others."""

PURE = (
    "choices",
    "messages",
    "geometry",
    "inference",
    "perception",
    "tracking",
    "flocking",
    "safety",
    "pilot",
    "mission",
    "obstacles",
)
"""No clock, no socket, no thread, no environment: what is tested is what flies."""
IMPURE_MODULES = {
    "asyncio",
    "threading",
    "multiprocessing",
    "concurrent",
    "time",
    "datetime",
    "socket",
    "zenoh",
    "random",
}

NETWORK_LIBRARIES = {"onnxruntime"}
"""Only inference runs networks."""
SIMULATOR_LIBRARIES = {"numba", "matplotlib", "jinja2", "markupsafe"}
"""Of the extra `sim`: only the simulator, flights at control level, campaigns and reports may need them."""
TOOL_LIBRARIES = {"torch", "onnx", "trimesh", "embreex", "pytest"}
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


def _folder(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _imported_folders(path: Path) -> set[str]:
    parts = [name.split(".") for name in _imports(path) if name.startswith("flockd.")]
    return {names[1] for names in parts if names[1] != "__version__"}


def _libraries(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in _imports(path)}


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def test_every_folder_has_its_place_in_the_table() -> None:
    assert {_folder(path) for path in MODULES} <= MAY_IMPORT.keys()


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_only_what_its_folder_may(path: Path) -> None:
    folder = _folder(path)
    assert _imported_folders(path) <= MAY_IMPORT[folder] | {folder}


@pytest.mark.parametrize("folder", PURE)
def test_the_pure_line_knows_no_clock_no_thread_and_no_network(folder: str) -> None:
    for path in (path for path in MODULES if _folder(path) == folder):
        assert not _libraries(path) & IMPURE_MODULES, path
        assert "environ" not in path.read_text(encoding="utf-8"), path
        assert "getenv" not in path.read_text(encoding="utf-8"), path


def test_only_inference_runs_networks() -> None:
    for path in MODULES:
        if _folder(path) != "inference":
            assert not _libraries(path) & NETWORK_LIBRARIES, path


def test_what_flies_needs_none_of_the_simulators_libraries() -> None:
    for path in MODULES:
        if _folder(path) not in {"sim", "report", "control_level", "campaign"}:
            assert not _libraries(path) & SIMULATOR_LIBRARIES, path
        assert not _libraries(path) & TOOL_LIBRARIES, path


ZENOH_SESSION = PACKAGE / "zenoh_session.py"
"""Opens and closes sessions, whatever goes through them."""
FRAMES_OVER_ZENOH = PACKAGE / "sources" / "shared_memory.py"
"""A drone's own camera frames may come over zenoh, under keys that no telemetry has."""
WATCHER = PACKAGE / "telemetry" / "watcher.py"
"""Reads telemetry, for the commands that people run."""
OPERATOR = PACKAGE / "telemetry" / "operator_client.py"
"""Sends what operators ask, for the commands that people run."""
FLEET_STATUS = PACKAGE / "telemetry" / "fleet_status.py"
"""The table of `flockd status`."""
REPLIES = PACKAGE / "telemetry" / "publisher.py"
"""Replies to queries; what it lets an operator ask says nothing of where another drone is."""


@pytest.mark.parametrize(
    ("library", "adapters"),
    [
        ("mavsdk", ["autopilot/mavsdk_link.py"]),
        (
            "pymavlink",
            [f"autopilot/fake_{what}.py" for what in ("autopilot", "checks", "telemetry")] + ["sim/ground_station.py"],
        ),
        ("pyulog", ["flight_log/ulog.py"]),
        ("joblib", ["campaign/process_engine.py"]),
        ("ray", ["campaign/ray_engine.py"]),
        (
            "foxglove",
            [
                f"foxglove_server/{what}.py"
                for what in ("camera_messages", "fleet_channels", "fleet_publisher", "map_places", "scene_messages")
            ]
            + ["foxglove_server/server.py", "foxglove_server/time_line.py"],
        ),
        ("rerun", ["view/flock_file.py", "view/rerun_file.py"]),
    ],
)
def test_an_outside_library_sits_behind_its_adapters(library: str, adapters: list[str]) -> None:
    assert [path for path in MODULES if library in _libraries(path)] == [PACKAGE / adapter for adapter in adapters]


def test_no_drone_reads_telemetry_to_fly() -> None:
    """Telemetry can be published; to read it is for the commands of people, and nothing that flies imports that."""
    from flockd.sources import shared_memory
    from flockd.telemetry.topics import PREFIX

    assert not shared_memory.PREFIX.startswith(f"{PREFIX.split('/')[0]}/")
    readers = {
        "declare_subscriber": {FRAMES_OVER_ZENOH, WATCHER},
        "declare_queryable": {REPLIES},
        "declare_querier": set(),
    }
    for path in MODULES:
        if _folder(path) != "telemetry" and path not in {FRAMES_OVER_ZENOH, ZENOH_SESSION}:
            assert "zenoh" not in _libraries(path), path
        text = path.read_text(encoding="utf-8")
        for word, allowed in readers.items():
            assert word not in text or path in allowed, path
        if _folder(path) not in {"cli", "doctor", "fleet_page", "foxglove_server"} and path != FLEET_STATUS:
            assert "flockd.telemetry.watcher" not in _imports(path), path
        if _folder(path) != "cli":
            assert "flockd.telemetry.operator_client" not in _imports(path), path
        if path not in {WATCHER, OPERATOR} and _folder(path) != "fleet_page":
            assert "flockd.telemetry.drone_queries" not in _imports(path), path


def test_one_file_opens_and_closes_sessions() -> None:
    for path in (path for path in MODULES if "zenoh" in _libraries(path) and path != ZENOH_SESSION):
        text = path.read_text(encoding="utf-8")
        assert "zenoh.open" not in text, path
        assert "zenoh.Config" not in text, path
        assert "session.close" not in text, path


def test_reports_and_flight_logs_know_no_simulator() -> None:
    """A report of a recording needs no simulator: all three meet in the flight log."""
    assert {"report", "sim"}.isdisjoint(MAY_IMPORT["flight_log"])
    assert "sim" not in MAY_IMPORT["report"]
    for path in (path for path in MODULES if _folder(path) in {"report", "flight_log"}):
        assert "sim" not in _imported_folders(path), path
        assert _folder(path) == "report" or "report" not in _imported_folders(path), path


def test_no_drone_gets_the_truth() -> None:
    """A simulator records where everybody truly is, for those who examine recordings; a pilot gets its own senses."""
    from flockd.pilot import FlockPilot

    for path in MODULES:
        if _folder(path) not in {"sim", "recording", "flight_log", "view"}:
            assert "flockd.recording.truth" not in _imports(path), path
    assert list(inspect.signature(FlockPilot.step).parameters) == ["self", "frames", "vehicle", "trace", "order"]


def test_the_doctor_sees_of_the_daemon_what_everybody_sees() -> None:
    import flockd.daemon

    public = {"flockd.daemon", *(f"flockd.daemon.{name}" for name in flockd.daemon.__all__)}
    for path in (path for path in MODULES if _folder(path) == "doctor"):
        assert {name for name in _imports(path) if name.startswith("flockd.daemon")} <= public, path


def test_inference_knows_no_drones() -> None:
    """It runs ONNX files as their manifests say; what a network is for is perception's."""
    assert {"perception", "geometry", "tracking", "pilot"}.isdisjoint(
        folder for path in MODULES if _folder(path) == "inference" for folder in _imported_folders(path)
    )


def test_nothing_imports_the_commands() -> None:
    """Library code does not live in cli; only the entry point of the package may call it."""
    for path in MODULES:
        if _folder(path) != "cli" and path != PACKAGE / "__main__.py":
            assert "cli" not in _imported_folders(path), path


FILES_OF_ONE_NAME = {
    "__init__.py": "marks a package",
    "errors.py": "the error types of its folder",
    "avoidance.py": "the section of the configuration for obstacles, and what flies around them",
    "rig.py": "the rig's section of the configuration, and the rig built from it",
}
"""Names that several files of the package may share, and why."""


def test_no_two_files_have_one_name_and_different_meaning() -> None:
    names = Counter(path.name for path in MODULES if _folder(path) != "cli")
    assert {name for name, count in names.items() if count > 1} <= FILES_OF_ONE_NAME.keys()
