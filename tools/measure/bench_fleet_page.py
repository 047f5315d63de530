"""How smooth the fleet page stays: publishes a made-up fleet's messages, and prints a headless Chromium's frame times.

python -m tools.measure.bench_fleet_page --drones 50 --seconds 20
python -m tools.measure.bench_fleet_page --drones 5 --pictures out/pages    # and pictures of the page

Chromium is /usr/bin/chromium, or what CHROMIUM names.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page, ViewportSize, expect, sync_playwright

from flockd.sim.free_ports import free_endpoint

_RUN = "import sys; from flockd.cli import main; sys.exit(main())"
_ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
SAMPLER = """seconds => new Promise(done => {
  const [times, began] = [[], performance.now()];
  let before = began;
  const tick = now => {
    times.push(now - before);
    before = now;
    if (now - began < 1000 * seconds) requestAnimationFrame(tick);
    else done(times.slice(1));
  };
  requestAnimationFrame(tick);
})"""
PATIENCE_MS = 120_000
WIDE = ViewportSize(width=1440, height=900)
NARROW = ViewportSize(width=390, height=844)


def main() -> int:
    """Measures, and prints."""
    parser = argparse.ArgumentParser(description="Frame times of the fleet page.")
    parser.add_argument("--drones", type=int, default=50)
    parser.add_argument("--rate", type=float, default=2.0, help="messages a second of each topic and drone")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--pictures", type=Path, help="a folder for pictures of the page")
    args = parser.parse_args()
    endpoint = free_endpoint()
    options = ("--drones", str(args.drones), "--rate", str(args.rate), "--commands", "hold,land,resume,goto")
    with served_page(endpoint) as (address, server), made_up_drones(endpoint, *options), chromium() as browser:
        page = browser.new_page(viewport=WIDE)
        page.goto(address)
        expect(page.locator("article")).to_have_count(args.drones, timeout=PATIENCE_MS)
        expect(page.locator(".plot .js-line").first).to_be_attached(timeout=PATIENCE_MS)
        _wait_for_rate(page, args.rate)
        busy_s, began_s = _processor_s(server), time.monotonic()
        frames_ms = np.array(page.evaluate(SAMPLER, args.seconds))
        share = (_processor_s(server) - busy_s) / (time.monotonic() - began_s)
        idle_ms = np.array(browser.new_page(viewport=WIDE).evaluate(SAMPLER, 5))
        heard_hz = _heard_hz(page)
        for what, times in (
            (f"{args.drones} drones at {heard_hz:.2f} Hz", frames_ms),
            ("an empty page beside it", idle_ms),
        ):
            print(
                f"{what}: {len(times)} frames, median {np.median(times):.1f} ms, 95th percentile "
                f"{np.percentile(times, 95):.1f} ms, longest {times.max():.0f} ms"
            )
        print(f"the server kept {share:.0%} of a processor core busy; load average {os.getloadavg()[0]:.1f}")
        if args.pictures is not None:
            _take_pictures(page, browser, args.pictures)
    return 0


@contextmanager
def served_page(endpoint: str, *options: str) -> Iterator[tuple[str, int]]:
    """`flockd fleet` to which drones connect at ``endpoint``: its address, with the key, and its process."""
    command = [sys.executable, "-c", _RUN, "fleet", "--port", "0", "--drones-at", endpoint, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            if address is None:
                raise SystemExit("flockd fleet printed no address")
            yield address[0], server.pid
        finally:
            server.kill()


@contextmanager
def made_up_drones(endpoint: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """`tools.docs.made_up_fleet`, which connects to ``endpoint``."""
    command = [sys.executable, "-m", "tools.docs.made_up_fleet", "--connect", endpoint, *options]
    with subprocess.Popen(command, cwd=Path(__file__).parents[2]) as drones:
        try:
            yield drones
        finally:
            drones.kill()


@contextmanager
def chromium() -> Iterator[Browser]:
    """The system's, without a window."""
    with sync_playwright() as playwright:
        path = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        yield playwright.chromium.launch(executable_path=path, args=[*_ARGUMENTS])


def _heard_hz(page: Page) -> float:
    """Steps a second, the mean of all cards."""
    texts = page.locator("article dd:has-text('/s'):not(:has-text('m/s'))").all_text_contents()
    return float(np.mean([float(text.split()[0]) for text in texts])) if texts else 0.0


def _wait_for_rate(page: Page, wanted_hz: float) -> None:
    """Until the drones publish as fast as they should, or a minute is over: loading the page takes processor time."""
    until_s = time.monotonic() + 60.0
    while _heard_hz(page) < 0.95 * wanted_hz and time.monotonic() < until_s:
        time.sleep(1.0)


def _processor_s(process: int) -> float:
    """That a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _take_pictures(page: Page, browser: Browser, folder: Path) -> None:
    """Wide and narrow, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    page.locator("article .name").nth(1).click()
    page.locator("article .look:enabled").first.click()
    expect(page.locator(".pictures img").first).to_have_js_property("naturalWidth", 320, timeout=PATIENCE_MS)
    page.screenshot(path=folder / "wide.png")
    page.emulate_media(color_scheme="dark")
    page.screenshot(path=folder / "wide-dark.png")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(NARROW)
    page.screenshot(path=folder / "narrow.png")
    page.screenshot(path=folder / "narrow-whole.png", full_page=True)
    page.locator("#all [data-command=hold]").click()
    page.screenshot(path=folder / "confirm.png")


if __name__ == "__main__":
    raise SystemExit(main())
