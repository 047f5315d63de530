"""Pages of a made-up fleet in a headless Chromium: /usr/bin/chromium, or what CHROMIUM names."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

_RUN = "from flockd.cli import program; program()"
_ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
HOLD = """async card => {
  document.querySelector(`${card} [data-command=hold]`).click();
  const answered = new Promise(done => {
    const observer = new MutationObserver(() => {
      if (!document.querySelector("#answers p")) return;
      observer.disconnect();
      done();
    });
    document.querySelectorAll("#answers p").forEach(one => one.remove());
    observer.observe(document.getElementById("answers"), { childList: true });
  });
  const began = performance.now();
  document.querySelector("#confirm .send").click();
  await answered;
  if (!document.querySelector("#answers p").textContent.includes("hold is being tried")) throw new Error("refused");
  return performance.now() - began;
}"""
PATIENCE_MS = 120_000
HELD = "article[data-key='made-up/drone1']"
"""The card of the drone that answers."""
WIDE = ViewportSize(width=1440, height=900)
NARROW = ViewportSize(width=390, height=844)


def hold_s(page: Page) -> float:
    """From the confirmed hold to the drone's answer on the page, by the browser's clock."""
    return float(page.evaluate(HOLD, HELD)) / 1000


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
    with subprocess.Popen(command, cwd=Path(__file__).parents[3]) as drones:
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
