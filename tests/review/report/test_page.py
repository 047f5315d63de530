"""The flight report, written from flights whose figures are known beforehand: a regular polygon that flies Eq. 43."""

from __future__ import annotations

import errno
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray

from flockd.review.flight_log.key_frames import KeyFrame
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.curves import error_curves, flight_curves
from flockd.review.report.filmstrip import filmstrip, load_plates, save_plates
from flockd.review.report.flight_folder import save_flight, write_report_files
from flockd.review.report.trajectories import gabriel_edges, obstacle_figure, trajectories
from tests.review.report.test_summary import flight_metadata

Array = NDArray[np.float64]
RADIUS_M = 2.1
SIDE_M = 2 * RADIUS_M * math.sin(math.pi / 5)  # of the pentagon: 2.4687 m
STEP_S = 0.5


def _flight(*, drones: int = 5, duration_s: float = 110.0, perception: str = "learned") -> FlightLog:
    """A polygon of drones at one height, noses north, on the paper's circle and its tangent at 1 m/s.

    By sight every translation is 0.02 m too long forward and -0.01 m to the right, every turn 0.5 degrees too far in
    yaw, every neighbour 1 % too far.
    """
    time_s = np.arange(0.0, duration_s, STEP_S)
    steps = len(time_s)
    course = np.minimum(time_s, 66.0) / 10
    desired = np.stack([np.cos(course), np.sin(course)], axis=1)
    middle = np.vstack([np.zeros(2), np.cumsum(desired * STEP_S, axis=0)[:-1]])
    around = 2 * np.pi * np.arange(drones) / drones
    corners = RADIUS_M * np.stack([np.cos(around), np.sin(around)], axis=1) if drones > 1 else np.zeros((1, 2))
    position = np.full((steps, drones, 3), -4.0)
    position[..., :2] = middle[:, None] + corners
    velocity = np.zeros((steps, drones, 3))
    velocity[..., :2] = desired[:, None]

    rotation, translation = np.full((steps, drones, 3, 3), np.nan), np.full((steps, drones, 3), np.nan)
    neighbours = np.full((steps, drones, drones, 3), np.nan)
    if perception != "truth":
        c, s = math.cos(math.radians(0.5)), math.sin(math.radians(0.5))
        rotation[1:] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        translation[1:] = np.diff(position, axis=0) + np.array([0.02, -0.01, 0.0])
        others = ~np.eye(drones, dtype=bool)
        neighbours[:, others] = 1.01 * (position[:, None] - position[:, :, None])[:, others]
    return FlightLog(
        time_s=time_s,
        position=position,
        velocity=velocity,
        attitude=np.broadcast_to(np.eye(3), (steps, drones, 3, 3)).copy(),
        desired=desired,
        command_velocity=velocity[..., :2],
        ego_rotation=rotation,
        ego_translation=translation,
        own_velocity_estimate=velocity,
        neighbour_position=neighbours,
        neighbour_velocity=np.broadcast_to(velocity[:, None], neighbours.shape).copy(),
        false_tracks=np.zeros((steps, drones), dtype=np.int64),
        truth_position=position,
        truth_velocity=velocity,
        stages_ms={} if perception == "truth" else {"flow": np.array([40.0, 60.0]), "ego_motion": np.array([5.0])},
        metadata=flight_metadata(
            scenario="polygon",
            perception=perception,
            flow="flow",
            drones=drones,
            duration_s=duration_s,
            seed=7,
            wall_s=duration_s * 4,
            circle_until_s=66.0,
        ),
    )


def _moment(*, time_s: float = 3.0) -> KeyFrame:
    """Two cameras; the same drone, label 2 and track 4, sits on the border between them."""
    rng = np.random.default_rng(0)
    cameras = ("back", "left")
    yy, xx = np.mgrid[0:96, 0:64]
    image = np.stack([xx * 3, yy * 2, 120 + 0 * xx], axis=2).astype(np.uint8)
    depth = np.where(yy < 40, np.inf, 1.5 + 0.13 * yy).astype(np.float32)
    labels = np.zeros((96, 64), np.uint8)
    labels[50:60, 0:12] = 2
    flow = rng.uniform(-8, 8, (96, 64, 2)).astype(np.float32)
    flow[:10] = np.nan
    return KeyFrame(
        time_s=time_s,
        drone=0,
        cameras=cameras,
        images=dict.fromkeys(cameras, image),
        depth=dict.fromkeys(cameras, depth),
        labels=dict.fromkeys(cameras, labels),
        flow=dict.fromkeys(cameras, flow),
        track_ids={2: 4},
        ranges={2: 3.214},
    )


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Texts need no figures, which take seconds."""
    monkeypatch.setattr("flockd.review.report.page._embed", lambda *_, **__: Markup("<svg></svg>"))


def _report(folder: Path, log: FlightLog, *moments: KeyFrame) -> str:
    save_flight(folder, log, moments)
    write_report_files(folder, log)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("undrawn")
def test_a_full_disk_leaves_no_half_of_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which `flockd report` would then leave as it was."""
    whole = Path.write_text

    def cut_off(path: Path, text: str, encoding: str) -> None:
        whole(path, text[: len(text) // 2], encoding=encoding)
        if path.suffix == ".html":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", cut_off)
    with pytest.raises(OSError, match="No space left"):
        _report(tmp_path, _flight(duration_s=5.0))
    assert not list(tmp_path.glob("*.html"))


class Page(HTMLParser):
    """A page read: its elements as a tree, its text, the links it follows, and whether every tag is closed in turn."""

    _VOID = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.root: dict[str, Any] = {"tag": "page", "attributes": {}, "children": [], "text": ""}
        self.text = ""
        self.links: list[tuple[str, str]] = []
        self.elements: list[dict[str, Any]] = []
        self._open = [self.root]
        self.feed(html)
        self.close()
        assert self._open == [self.root]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {name: value or "" for name, value in attrs}
        self.links += [(tag, named[name]) for name in ("src", "href", "srcset", "data", "action") if name in named]
        self.elements.append({"tag": tag, "attributes": named, "children": [], "text": ""})
        self._open[-1]["children"].append(self.elements[-1])

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in self._VOID:
            self._open.append(self.elements[-1])

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop()["tag"] == tag

    def handle_data(self, data: str) -> None:
        self._open[-1]["text"] += data
        if not {"style", "script"} & {element["tag"] for element in self._open}:
            self.text += data

    @property
    def rows(self) -> list[list[tuple[str, bool]]]:
        """Of all tables, each cell's text and mark."""
        return [
            [(cell["text"], cell["attributes"].get("class") == "met") for cell in row["children"]]
            for row in self.elements
            if row["tag"] == "tr"
        ]

    def row(self, name: str, number: int = 0) -> list[tuple[str, bool]]:
        """Text and mark of the cells right of the heading `name`, where it comes for the `number`-th time."""
        return [row[1:] for row in self.rows if row and row[0][0] == name][number]


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("five")
    _report(folder, _flight(), _moment(), _moment(time_s=50.0))
    return folder


@pytest.fixture(scope="module")
def five_page(five: Path) -> Page:
    return Page((five / "report.html").read_text(encoding="utf-8"))


def test_the_page_needs_nothing_but_itself(five: Path, five_page: Page) -> None:
    html = (five / "report.html").read_text(encoding="utf-8")
    assert "http" not in html
    assert "@import" not in html
    assert not {element["tag"] for element in five_page.elements} & {"link", "iframe", "object", "embed"}
    assert "script" not in {tag for tag, _ in five_page.links}, "scripts stand in the page"
    assert [link for tag, link in five_page.links if tag == "img" and not link.startswith("data:image/")] == []
    assert [link for _, link in five_page.links if not link.startswith(("data:", "#"))] == []
    assert set(re.findall(r"url\(([^)]{0,1})", html)) <= {"#"}
    assert len(html) < 6e6
    targets = re.findall(r' id="([^"]+)"', html)
    references = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', html))
    assert len(targets) == len(set(targets))
    assert {one or other for one, other in references} == set(targets), "each reference inside it has one target"
    names = {path.name for path in (five / "figures").iterdir()}
    assert names == {"trajectories.png", "curves.png", "errors.png", "filmstrip_1.webp", "filmstrip_2.webp"}
    for name in names:
        picture = cv2.imread(str(five / "figures" / name))
        assert picture is not None
        assert picture.std() > 5, f"{name} is empty"


@pytest.mark.usefixtures("undrawn")
def test_a_reader_chooses_drone_and_moment_and_plays_the_flight(tmp_path: Path) -> None:
    moments = [replace(_moment(time_s=time_s), drone=drone) for drone in (0, 2) for time_s in (3.0, 9.0)]
    log = _flight(drones=3, duration_s=10.0)
    html = _report(tmp_path, log, *moments)
    assert re.findall(r'data-drone="([^"]+)" data-time="([^"]+)"', html) == [
        ("drone 1", "3.000"), ("drone 1", "9.000"), ("drone 3", "3.000"), ("drone 3", "9.000"),
    ]  # fmt: skip
    assert "<option>drone 1</option><option>drone 3</option>" in html
    data = json.loads(re.search(r'<script type="application/json">(.*?)</script>', html)[1])  # type: ignore[index]
    assert data["time"] == log.time_s.tolist()
    north, east, down = log.position[4, 2]
    assert data["position"][4][2] == pytest.approx([north, east, -down], abs=0.005)


def _of(log: FlightLog, **metadata: object) -> FlightLog:
    return replace(log, metadata=log.metadata.model_copy(update=metadata))


def _moved(log: FlightLog, axis: int, to_m: float) -> FlightLog:
    """With its first drone that much farther along an axis."""
    log.position[:, 0, axis] += to_m
    return log


BEGUN = {"began": "2026-11-21T09:05:00+00:00", "version": "0.1.0", "scenario": "<script>alert(1)</script>"}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("log", "said", "unsaid"),
    [
        # 0.25 times real time: 440 s of computing for 110 s.
        (_flight(), "Five drones flew 110 s by sight and stayed one flock|seed 7|2.47|0.25|100.0", "nan"),
        (
            _flight(perception="truth"),
            "Five drones flew 110 s with exact states and stayed one flock|No camera images were kept|No stage of this "
            "flight was timed|there is no companion flight",
            "95th percentile",
        ),
        (_flight(duration_s=20.0), "This flight was too short|On the circle, t < 66 s", "Straight on"),
        (_flight(drones=1, duration_s=10.0), "One drone flew 10 s by sight", "Closest"),
        (_moved(_flight(duration_s=20.0), 0, -40.0), "but did not stay one flock", "and stayed one flock"),
        (
            _moved(_of(_flight(drones=3, duration_s=20.0), **BEGUN), 2, -2.25),
            "begun 2026-11-21 09:05 UTC, flockd 0.1.0|–6.2 m|<script>alert|flew 5 drones, this flight has 3",
            "Five drones",
        ),
    ],
    ids=["by sight", "exact states", "short", "alone", "apart", "three"],
)
def test_the_page_speaks_of_the_flight_it_shows(log: FlightLog, said: str, unsaid: str, tmp_path: Path) -> None:
    html = _report(tmp_path, log)
    text = " ".join(Page(html).text.split())
    assert [sentence for sentence in said.split("|") if sentence not in text] == []
    assert unsaid not in text
    assert "<script>alert" not in html, "a name cannot break the page"


def test_table_2_has_our_errors_and_marks_those_that_meet_the_paper(five_page: Page) -> None:
    # x 0.02 m, y 0.01 m, yaw 0.5 degrees, no pitch and roll; 1 % of the diagonal is the largest error of distance.
    diagonal_m = 2 * RADIUS_M * math.sin(2 * math.pi / 5)
    expected = ["0.0200", "0.0100", "0.5000", "0.0000", "0.0000", f"{0.01 * diagonal_m:.4f}"]
    circle, straight = five_page.row("maximum", 0), five_page.row("maximum", 1)
    assert [cell.lstrip("-") for cell, _ in circle] == expected
    assert [met for _, met in circle] == [True] * 6
    # The paper's maxima after 66 s: 0.0099 m forward, the rest is met; 0.0399 m of distance against 0.0333 m is not.
    assert [met for _, met in straight] == [False, True, True, True, True, False]
    assert [met for _, met in five_page.row("mean", 1)] == [False, True, True, True, True, True]
    assert [cell for cell, _ in five_page.row("the paper’s maximum", 1)][:2] == ["0.0099", "0.0155"]


def test_table_3_and_the_flock(five_page: Page) -> None:
    # Nothing ever moves within the polygon: converged from the start in shape, from the end of the circle in velocity.
    cells = [cell.lstrip("-") for cell, _ in five_page.row("By sight")]
    assert cells == ["66.0", "0.0000", "0.0000", "0.0", "0.0000", "0.0000"]
    assert [cell for cell, _ in five_page.row("the paper’s", 1)] == ["67.0", "0.0000", "–", "67.0", "0.1273", "–"]
    assert five_page.row("smallest distance in 3D, m")[0][0] == f"{SIDE_M:.3f}"
    assert five_page.row("order, last 10 s")[0][0] == "1.0000"
    assert five_page.row("share known of those within 10 m")[0][0] == "1.0000"
    assert five_page.row("ego motion")[0][0] == "5.0"
    assert five_page.row("flow")[0][0] == "50.0"


def test_fifty_drones_fit_on_a_page(tmp_path: Path) -> None:
    html = _report(tmp_path, _flight(drones=50, duration_s=5.0))
    text = Page(html).text
    assert "50 drones flew 5 s by sight, but came within 0.26 m of each other" in text  # 2 * 2.1 * sin(pi / 50)
    assert "drone 50" in text
    assert "drone 25" not in text
    assert "median drone" in text
    assert len(html) < 6e6


def _axes(figure_axes: list[Axes], *, label: str) -> Axes:
    return next(axes for axes in figure_axes if label in (axes.get_ylabel(), axes.get_title(loc="left")))


def test_the_course_is_drawn_without_jumps_through_a_full_turn() -> None:
    # Eq. 43 turns by 6.6 rad = 378.15 degrees; the flight follows exactly.
    course = _axes(flight_curves(_flight()).axes, label="course, °")
    for line in course.get_lines()[:5]:
        drawn = np.asarray(line.get_ydata())
        assert drawn[0] == pytest.approx(0.0, abs=1e-9)
        assert drawn[-1] == pytest.approx(math.degrees(6.6))
        assert np.abs(np.diff(drawn)).max() < 3.0


def test_the_sums_of_the_polygon_are_the_analytic_ones() -> None:
    curves = flight_curves(_flight()).axes
    before, after = (np.asarray(line.get_ydata()) for line in _axes(curves, label="Σ obj1").get_lines()[:2])
    np.testing.assert_allclose(before, -2.5)
    np.testing.assert_allclose(after, 0.0, atol=1e-12)
    # Each of five sees two at the side's and two at the diagonal's distance (Eq. 45 with equal velocities).
    diagonal_m = 2 * RADIUS_M * math.sin(2 * math.pi / 5)
    shape = 5 * (2 * abs(3.5 - SIDE_M) + 2 * abs(3.5 - diagonal_m))
    np.testing.assert_allclose(np.asarray(_axes(curves, label="Σ obj2").get_lines()[0].get_ydata()), shape)


def test_paths_have_equal_axes_with_north_up() -> None:
    figure = trajectories(_flight())
    paths = _axes(figure.axes, label="Paths")
    assert paths.get_aspect() == 1.0
    assert paths.get_ylim()[0] < paths.get_ylim()[1]
    texts = [text.get_text() for text in _axes(figure.axes, label="Formation at the end, t = 109.5 s").texts]
    assert texts.count("2.47") == 5, "sides, not diagonals"
    pentagon = np.stack([np.cos(np.arange(5) * 0.4 * np.pi), np.sin(np.arange(5) * 0.4 * np.pi)], axis=1)
    sides = {tuple(sorted((i, (i + 1) % 5))) for i in range(5)}
    assert {(i, j) for i, j in np.argwhere(np.triu(gabriel_edges(pentagon))).tolist()} == sides
    errors = error_curves(_flight(duration_s=10.0))
    assert errors is not None
    y = np.asarray(_axes(errors.axes, label="Translation y, m").get_lines()[0].get_ydata())
    np.testing.assert_allclose(y, [np.nan, *[-0.01] * 19])
    alone = {axes.get_ylabel() for axes in flight_curves(_flight(drones=1, duration_s=10.0)).axes}
    assert not {"distance, m", "Σ obj2"} & alone, "one drone is no flock"


def test_obstacles_are_drawn_where_they_stand() -> None:
    log = _flight(duration_s=10.0)
    clearance = np.full(log.position.shape[:2], 4.0)
    clearance[6, 2] = 0.5
    north, east, down = log.position[6, 2]
    pole = [north, east + 1.0, 0.15, 0.0, 0.0, 0.0, 8.0]
    wall = [north - 5.0, east, 2.0, 0.1, math.pi / 2, 0.0, -down + 1.0]
    metadata = log.metadata.model_copy(update={"drone_radius_m": 0.35})
    log = replace(log, obstacles=np.array([pole, wall]), clearance=clearance, metadata=metadata)
    paths = _axes(trajectories(log).axes, label="Paths")
    shapes = [path.get_extents() for group in paths.collections for path in group.get_paths()]
    assert [shape.width for shape in shapes] == pytest.approx([0.3, 4.0], abs=0.01), "the wall's length points east"
    assert (shapes[0].x0 + shapes[0].x1) / 2 == pytest.approx(east + 1.0, abs=0.01)
    figure = obstacle_figure(log)
    assert figure is not None
    curves = _axes(figure.axes, label="clearance, m")
    assert np.min([np.asarray(line.get_ydata()) for line in curves.get_lines()[:5]]) == pytest.approx(0.15)
    assert obstacle_figure(_flight(duration_s=10.0)) is None


def test_a_plate_survives_its_file(tmp_path: Path) -> None:
    """WebP of quality 82 is within some grey levels of what was drawn."""
    moment, path = _moment(), tmp_path / "filmstrip.npz"
    save_plates(path, [moment, replace(_moment(time_s=9.5), drone=1)])
    first, later = load_plates(path)
    assert [(one.drone, one.time_s) for one in (first, later)] == [("drone 1", 3.0), ("drone 2", 9.5)]
    drawn = filmstrip(moment)
    assert (first.height, first.width) == drawn.shape[:2]
    stored = np.asarray(cv2.imdecode(np.frombuffer(first.webp, np.uint8), cv2.IMREAD_COLOR_RGB), float)
    assert np.abs(stored - drawn).mean() < 4.0
    assert load_plates(tmp_path / "none.npz") == []


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float, str]]:
    """What a plate says: left and base in pixels of the part it is written on, and the text."""
    kept: list[tuple[float, float, str]] = []
    monkeypatch.setattr(
        "flockd.review.report.filmstrip.write", lambda _, left, base, text, *__: kept.append((left, base, text))
    )
    return kept


def test_a_moment_shows_its_cameras_in_rig_order_with_named_drones(written: list[tuple[float, float, str]]) -> None:
    filmstrip(_moment())
    names = [text for *_, text in written]
    assert [name for name in names if name in {"left", "back"}] == ["left", "back"]
    assert names.count("#4  3.21 m") == 2


def test_an_arrow_ends_at_the_border_of_its_image() -> None:
    """At the left border of each image everything moves 100 px to the left."""
    flow = np.ones((96, 64, 2), np.float32)
    flow[:, :4] = -100.0, 0.0
    drawn = filmstrip(replace(_moment(), flow={"left": flow, "back": flow}))
    plate = drawn[-700:]  # within the row of the flow
    assert np.ptp(plate[:, 48:560].astype(int)) > 100
    for beside in (plate[:, 40:48], plate[:, 560:568]):
        assert np.array_equal(np.unique(beside.reshape(-1, 3), axis=0), [(0x14, 0x18, 0x1F)])
    bare = filmstrip(replace(_moment(), flow={}, depth={"left": _moment().depth["left"]}, labels={}))
    assert bare.shape == drawn.shape, "a camera may lack a map"
    assert len(np.unique(bare[-700:, 48:560].reshape(-1, 3), axis=0)) == 1, "no flow is drawn"


def test_names_of_close_drones_do_not_cover_each_other(written: list[tuple[float, float, str]]) -> None:
    moment = _moment()
    labels = np.zeros((96, 64), np.uint8)
    labels[50:56, 20:28], labels[50:56, 32:40] = 1, 2
    filmstrip(replace(moment, labels={"left": labels}, ranges={1: 3.0, 2: 3.1}, track_ids={2: 4}))
    (_, one, first), (_, other, second) = [name for name in written if name[2].startswith(("#", "new"))]
    assert (first, second) == ("new  3.00 m", "#4  3.10 m")
    assert abs(one - other) >= 18, "a line apart"
