"""The report's script, run on a whole report: it plays the flight and shows the chosen plate."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from py_mini_racer import MiniRacer

from tests.review.report.test_page import Page, _flight, _moment, _report, undrawn

__all__ = ["undrawn"]

SIDE_M = 2.1 * 3**0.5
"""Side of a triangle whose corners are 2.1 m from its middle."""


class _Browser:
    """A page with its script running, and the parts of its player."""

    def __init__(self, html: str) -> None:
        self._engine = MiniRacer()
        script = html.rpartition("<script>")[2].partition("</script>")[0]
        self._engine.eval(f"const page = {json.dumps(Page(html).root)};")
        self._engine.eval((Path(__file__).parent / "browser.js").read_text(encoding="utf-8"))
        self._engine.eval(f"{{{script}}}")

    def __call__(self, expression: str) -> Any:
        return json.loads(str(self._engine.eval(f"JSON.stringify({expression})")))

    def do(self, element: str, event: str, **values: object) -> None:
        """Sets properties of the first such element, and tells it of an event."""
        changes = "".join(f"e.{name} = {json.dumps(value)};" for name, value in values.items())
        self._engine.eval(
            f"{{const e = document.querySelector({json.dumps(element)}); {changes} e.dispatch('{event}');}}"
        )

    def shown(self) -> str:
        return str(self("document.querySelector('.player').querySelector('output').textContent"))

    def button(self) -> str:
        return str(self("document.querySelector('button').textContent"))

    def circles(self) -> list[tuple[float, float]]:
        """Where the drones are drawn, in pixels right and down."""
        drawn = self("document.querySelector('canvas').drawn.filter((one) => !one.text)")
        return [(one["x"], one["y"]) for one in drawn]


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three drones on a triangle fly 10 s; plates of two of them at two moments; without figures."""
    moments = [replace(_moment(time_s=time_s), drone=drone) for drone in (0, 2) for time_s in (3.0, 9.0)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flockd.review.report.page._embed", lambda *_, **__: Markup(""))
        return _report(tmp_path_factory.mktemp("played"), _flight(drones=3, duration_s=10.0), *moments)


def test_play_runs_the_flight_to_its_end_at_the_chosen_speed(html: str) -> None:
    page = _Browser(html)
    assert page("document.querySelector('.player').hidden") is False
    assert (page.button(), page.shown()) == ("Play", f"0.0 s, closest {SIDE_M:.2f} m in 3D")
    page.do("button", "click")
    assert page.button() == "Pause"
    page("frame(-30)")
    assert page.shown().startswith("0.0 s"), "a frame may have begun before the click"
    page("frame(500)")
    assert page.shown().startswith("2.0 s"), "half a second at four times real time"
    page.do("[name=rate]", "input", value="10")
    page("frame(300)")
    assert page.shown().startswith("5.0 s")
    assert page("document.querySelector('[name=time]').value") == pytest.approx(5.0)
    page("frame(2000)")
    assert page("frame(100)") == 0, "after the end nothing waits for another frame"
    assert (page.button(), page.shown()[:5]) == ("Play", "9.5 s")
    page.do("button", "click")
    page("frame(100)")
    assert page.shown().startswith("1.0 s"), "once more from the beginning"
    page.do("button", "click")
    page("frame(500)")
    assert (page.button(), page.shown()[:5]) == ("Play", "1.0 s"), "it pauses"
    page.do("[name=time]", "input", value="7.25")
    assert page.shown().startswith("7.3 s")


def test_drones_are_drawn_with_north_up_and_true_to_scale(html: str) -> None:
    page = _Browser(html)
    first, second, third = page.circles()
    # The corners lie north, and 120 and 240 degrees clockwise from there.
    assert first[1] < second[1] == pytest.approx(third[1])
    assert second[0] > first[0] > third[0]
    side_px = second[0] - third[0]
    assert (second[1] - first[1]) / side_px == pytest.approx(3**0.5 / 2, rel=0.01)
    page.do("[name=follow]", "input", checked=True)
    followed = page.circles()
    assert sum(x for x, _ in followed) / 3 == pytest.approx(300.0, abs=0.5), "the middle of the canvas"
    assert sum(y for _, y in followed) / 3 == pytest.approx(200.0, abs=0.5)
    assert followed[1][0] - followed[2][0] > side_px


@pytest.mark.usefixtures("undrawn")
def test_a_round_obstacle_is_drawn_where_it_stands(tmp_path: Path) -> None:
    log = _flight(drones=3, duration_s=10.0)
    under_the_second = [*log.position[0, 1, :2], 0.3, 0.0, 0.0, 0.0, 8.0]
    page = _Browser(_report(tmp_path, replace(log, obstacles=np.array([under_the_second]))))
    obstacle, _, second, _ = page.circles()
    assert obstacle == pytest.approx(second, abs=0.2)


def test_a_reader_chooses_the_plate_of_a_drone_and_moment(html: str) -> None:
    page = _Browser(html)
    plates = "document.querySelectorAll('figure').filter((one) => !one.hidden)"
    visible = f"{plates}.map((one) => [one.dataset.drone, one.dataset.time])"
    assert page(visible) == [["drone 1", "3.000"]]
    page.do("[name=moment]", "input", value="1")
    assert page(visible) == [["drone 1", "9.000"]]
    page.do("[name=drone]", "input", value="drone 3")
    assert page(visible) == [["drone 3", "9.000"]]
    page.do("figure", "click")
    assert page("document.querySelector('figure').classList.contains('large')") is True


def test_a_browser_shows_the_flight_and_begins_to_play_it(html: str, tmp_path: Path) -> None:
    """A real one, in which `Play` is pressed as soon as the page is there."""
    names = ("chromium", "chromium-browser", "google-chrome")
    browser = next((found for name in names if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip("chromium is not here")
    page, pressed = tmp_path / "report.html", "<script>document.querySelector('.player button').click()</script>"
    page.write_text(html.replace("</body>", f"{pressed}</body>"), encoding="utf-8")
    flags = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}")
    command = [browser, *flags, "--virtual-time-budget=1000", "--dump-dom", page.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    told = re.search(r"<output[^>]*>[0-9.]+ s, closest ([0-9.]+) m in 3D", shown)
    assert told is not None, re.findall("<output.*", shown)
    assert float(told[1]) == pytest.approx(SIDE_M, abs=0.015), "positions are kept to the centimetre"
    assert re.search(r"<button[^>]*>Pause</button>", shown)
