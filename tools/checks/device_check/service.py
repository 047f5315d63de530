"""Checks of flockd as a service: the real `flockd run` with the shipped networks, under the real unit.

python -m tools.checks.device_check.service FINDINGS START

`tools/checks/check_device.py` starts it in the virtual machine, and reads what it writes to FINDINGS. START is a file
with the documentation's lines that start the unit. The autopilot is a fake. The cameras are virtual: the front one has
a process of ours behind it, the back one is of `vivid` and can be unplugged.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config.source import CameraDeviceParameters
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.recording.reader import Recording
from flockd.onboard.sources.image_formats import MjpegFormat
from flockd.onboard.sources.v4l2_device import V4l2Device
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tools.checks.device_check.cameras import COUNT, WEBCAM, Feeder, control, image, load
from tools.checks.device_check.findings import PATIENCE_S, UNIT, Finding, run, run_checks, shown, soon, until

CONFIG, RECORDINGS = "/etc/flockd/drone.yaml", Path("/var/lib/flockd")
PORT, ENDPOINT = 14540, "tcp/127.0.0.1:7447"
CAMERAS = ("front", "back")
FRONT_SIZE, BACK_SIZE, RATE_HZ, SILENCE_S = (160, 120), (320, 180), 5.0, 0.8
"""As in drone.yaml."""
MAX_EXPOSURE = 1.5
NOTICED_S = 0.5
"""Three frame periods, or this."""
SETPOINTS_STOP_S, RESTARTED_S = 0.5, 8.0
WATCHDOG_S, STOPPED_S = 2.0, 30.0
"""The unit's WatchdogSec and TimeoutStopSec."""
WATCHED_S = 10.0
LITTLE_MEMORY, OUT_OF_MEMORY_S = "32M", 5.0
"""For the process, which has a few hundred megabytes; until Linux has killed it and the autopilot has noticed."""
LOOK_S = 0.5
"""Asking systemd takes an emulated processor a while; systemd itself has exact times."""


class Service:
    """The unit, its fake autopilot and its watcher."""

    def __init__(self, start: str) -> None:
        """``start``: the lines of the documentation that start the unit."""
        self._start = start
        self._autopilot = FakeAutopilot(PORT).start()
        self._watcher = FleetWatcher("check", listen=(), connect=(ENDPOINT,))
        self._front: Feeder | None = None
        self.checks = (
            *(self.starts, self.runs, self.flies, self.is_asked_to_reload),
            *(self.hangs, self.runs_out_of_memory, self.stops),
        )

    def close(self) -> None:
        """End all processes."""
        self._watcher.close()
        self._autopilot.close()
        if self._front is not None:
            self._front.close()

    def starts(self) -> Iterator[Finding]:
        """No camera gives a frame at first: one is in use by us, and nobody feeds the other."""
        verify = run("systemd-analyze", "verify", f"/etc/systemd/system/{UNIT}").strip()
        yield Finding("unit verified", not verify, verify or "no complaint", "no complaint")
        *_, verdict = run("systemd-analyze", "security", "--no-pager", UNIT).splitlines()
        exposure = float(verdict.split(": ")[1].split()[0])
        yield Finding("unit's exposure", exposure <= MAX_EXPOSURE, f"{exposure:g}", f"at most {MAX_EXPOSURE:g}")
        taken = CameraDeviceParameters(name="back", device=WEBCAM, pixel_format="yuyv", rate_hz=RATE_HZ)
        with V4l2Device(taken, BACK_SIZE):
            starting = subprocess.Popen(["bash", "-ec", self._start])
            until(lambda: "in use by another program" in shown("StatusText"), "the unit to tell of it", look_s=LOOK_S)
            state = shown("ActiveState")
        yield Finding("not ready without frames", state == "activating", state, "activating")
        freed_s = time.monotonic()
        self._front = Feeder(FRONT_SIZE, RATE_HZ)
        starting.wait(PATIENCE_S)
        took_s, state = time.monotonic() - freed_s, shown("ActiveState")
        yield Finding(
            "ready with frames", state == "active", f"{state} {took_s:.1f} s after a camera was free", "active"
        )

    def runs(self) -> Iterator[Finding]:
        """Ten seconds of its life, after two images of each camera: the loopback gives the first the number 0."""
        until(lambda: all(self._counts(camera).get("received", 0) > 1 for camera in CAMERAS), "both cameras")
        before, begun_s, feeds = self._message("computer"), time.monotonic(), set[int]()
        while time.monotonic() - begun_s < WATCHED_S:
            feeds.add(int(shown("WatchdogTimestampMonotonic")))
            time.sleep(0.2)
        after = self._message("computer")
        gaps_s = [1e-6 * (b - a) for a, b in pairwise(sorted(feeds))]
        yield Finding(
            "watchdog", len(gaps_s) > 3 and max(gaps_s) < WATCHDOG_S,
            f"fed {len(gaps_s)} times, at most {max(gaps_s, default=WATCHED_S):.2f} s apart",
            f"less than {WATCHDOG_S:g} s apart",
        )  # fmt: skip
        for camera in CAMERAS:
            counts, was = after["cameras"][camera]["counts"], before["cameras"][camera]["counts"]
            grown = {
                what: counts.get(what, 0) - was.get(what, 0) for what in ("received", "lost", "corrupt", "flagged")
            }
            hz = grown.pop("received") / (after["time_s"] - before["time_s"])
            yield Finding(
                f"{camera} camera of the unit", abs(hz - RATE_HZ) < 0.1 * RATE_HZ and not any(grown.values()),
                f"{hz:.1f} Hz; {grown}", f"{RATE_HZ:g} Hz within 10 %, no gap",
            )  # fmt: skip

    def flies(self) -> Iterator[Finding]:
        """The pilot brings it up and selects offboard; in flight its cameras fail one after the other."""
        self._fly()
        time.sleep(WATCHED_S)
        came_s = [time_s for time_s, _ in self._autopilot.setpoints if time_s > time.monotonic() - WATCHED_S]
        hz, worst_ms = len(came_s) / WATCHED_S, 1e3 * max(after - before for before, after in pairwise(came_s))
        yield Finding(
            "flies", hz > 19.0, f"{hz:.1f} setpoints a second, at most {worst_ms:.0f} ms apart", "20 a second"
        )
        command = ["runuser", "-u", "flockd", "--", "/opt/flockd/bin/flockd", "run", "--config", CONFIG]
        ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        last = (ended.stderr.strip().splitlines() or ["nothing"])[-1]
        yield Finding(
            "a second instance", ended.returncode == 69 and "another flockd" in last,
            f"exit {ended.returncode}, {last!r}", "exit 69, says who flies", row=26,
        )  # fmt: skip
        opened, pulled_s = self._counts("back")["opened"], control("disconnect")
        lost_s = _told_since(pulled_s, "a camera is lost: back unplugged")
        yield soon("unplugged in flight", lost_s - pulled_s, NOTICED_S, row=5)
        back_s = _told_since(lost_s, "normal")
        again = self._counts("back")["opened"] - opened
        yield Finding(
            "plugged in again in flight", again > 0 and shown("NRestarts") == "0",
            f"opened again; flies as before after {back_s - lost_s:.1f} s", "opened again, by the same process",
        )  # fmt: skip
        assert self._front is not None
        silent_s = self._front.fall_silent()
        yield soon(
            "silent in flight", _told_since(silent_s, "a camera is lost: front") - silent_s, SILENCE_S + 0.1, row=5
        )
        spoke_s = self._front.go_on()
        back_s = _told_since(spoke_s, "normal")
        yield Finding(
            "speaks again in flight", passed=True, measured=f"after {back_s - spoke_s:.1f} s", wanted="it does"
        )

    def is_asked_to_reload(self) -> Iterator[Finding]:
        """In flight: by systemctl, which refuses, and by SIGHUP. After TimeoutStopSec systemd would kill it."""
        until(lambda: self._autopilot.mode == "OFFBOARD", "the flight")
        flies = shown("MainPID")
        asked = subprocess.run(["systemctl", "reload", UNIT], capture_output=True, text=True, check=False)
        os.kill(int(flies), signal.SIGHUP)
        time.sleep(STOPPED_S + WATCHED_S)
        state, same = shown("ActiveState"), shown("MainPID") == flies
        yield Finding(
            "a reload in flight",
            asked.returncode != 0 and (state, same, self._autopilot.mode) == ("active", True, "OFFBOARD"),
            f"{asked.stderr.strip()!r}; {state}, {'the same' if same else 'another'} process; {self._autopilot.mode}; "
            f"{run('systemctl', '--version').splitlines()[0]}",
            "refused, the flight undisturbed",
        )  # fmt: skip

    def hangs(self) -> Iterator[Finding]:
        """Stopped in flight as by a debugger: nothing in it runs any more, and it ends only when it is killed."""
        stopped_s = time.monotonic()
        os.kill(int(shown("MainPID")), signal.SIGSTOP)
        until(lambda: self._autopilot.mode != "OFFBOARD", "the autopilot to see that setpoints stopped")
        yield soon("setpoints stop", max(self._autopilot.setpoints[-1][0] - stopped_s, 0.0), SETPOINTS_STOP_S, row=45)
        until(lambda: shown("NRestarts") == "1" and shown("MainPID") != "0", "the unit to start again", look_s=LOOK_S)
        began_s = 1e-6 * int(shown("ExecMainStartTimestampMonotonic"))
        yield soon("a hang is restarted", began_s - stopped_s, RESTARTED_S, row=10)
        yield self._is_idle("idle after a restart in the air")

    def runs_out_of_memory(self) -> Iterator[Finding]:
        """The pilot lands, it flies again, and in the air the unit's memory is cut to less than it has."""
        self._land()
        self._fly()
        restarts, cut_s = int(shown("NRestarts")), time.monotonic()
        run("systemctl", "set-property", "--runtime", UNIT, f"MemoryMax={LITTLE_MEMORY}")
        until(lambda: self._autopilot.mode != "OFFBOARD", "the autopilot to see that setpoints stopped")
        yield soon("out of memory in flight", time.monotonic() - cut_s, OUT_OF_MEMORY_S, row=28)
        run("systemctl", "set-property", "--runtime", UNIT, "MemoryMax=1G")
        until(lambda: int(shown("NRestarts")) > restarts, "the unit to start again", look_s=LOOK_S)
        yield self._is_idle("idle after it ran out of memory")

    def stops(self) -> Iterator[Finding]:
        """The pilot lands; flockd, which saw it on the ground, flies again, and is stopped in the air."""
        self._land()
        self._fly()
        time.sleep(WATCHED_S)
        begun_s = time.monotonic()
        run("systemctl", "stop", UNIT)
        took_s, result, status = time.monotonic() - begun_s, shown("Result"), shown("ExecMainStatus")
        holds = self._autopilot.mode == "LOITER" and not self._autopilot.failsafe
        yield Finding(
            "clean stop in the air", (result, status) == ("success", "0") and holds and took_s < STOPPED_S,
            f"{result}, exit {status} after {took_s:.1f} s; the autopilot {'holds' if holds else 'fails safe'}",
            f"exit 0 within {STOPPED_S:g} s, the autopilot holds", row=27,
        )  # fmt: skip
        recording = Recording(max(RECORDINGS.glob("*.mcap"), key=lambda path: path.stat().st_mtime))
        decode = MjpegFormat(FRONT_SIZE).pixels
        known = {decode(image(FRONT_SIZE, number)).tobytes() for number in range(COUNT)}
        seen = [step.frames.frames["front"].image for step in recording.steps() if "front" in step.frames.frames]
        equal = sum(np.ascontiguousarray(one).tobytes() in known for one in seen)
        yield Finding(
            "recorded images", 0 < len(seen) == equal and recording.contents.finished,
            f"{equal} of {len(seen)} equal what the camera was fed with in every pixel; "
            f"the recording is {'finished' if recording.contents.finished else 'cut off'}", "all, finished",
        )  # fmt: skip

    def _is_idle(self, check: str) -> Finding:
        """Ready after a restart in the air, where it leaves the autopilot to its failsafe."""
        ready_s = until(lambda: shown("ActiveState") == "active", "the unit to be ready again", look_s=LOOK_S)
        began_s = 1e-6 * int(shown("ExecMainStartTimestampMonotonic"))
        time.sleep(WATCHED_S)
        state = self._message("flight", ready_s)["state"]
        sent = sum(time_s > began_s for time_s, _ in self._autopilot.setpoints)
        found = f"{state}; {sent} setpoints, ready after {ready_s - began_s:.0f} s"
        return Finding(check, (state, sent) == ("idle", 0), found, "idle, no setpoint", row=28)

    def _land(self) -> None:
        self._autopilot.pilot_selects("LAND")
        until(lambda: not self._autopilot.armed, "the landing")

    def _fly(self) -> None:
        """Arm, take off and select offboard, once flockd has seen the vehicle on the ground."""
        until(
            lambda: "started" not in [reason["event"] for reason in self._message("flight")["reasons"]],
            "flockd to see the vehicle on the ground",
        )
        self._autopilot.pilot_arms()
        self._autopilot.pilot_selects("TAKEOFF")
        until(lambda: self._autopilot.mode == "LOITER", "the height")
        until(lambda: self._message("flight")["state"] == "ready", "flockd to be ready")
        self._autopilot.pilot_selects("OFFBOARD")
        until(lambda: self._message("flight")["state"] == "normal", "a quiet flight")

    def _counts(self, camera: str) -> Mapping[str, int]:
        counts: Mapping[str, int] = self._message("computer")["cameras"][camera]["counts"]
        return counts

    def _message(self, topic: str, since_s: float | None = None) -> Mapping[str, Any]:
        """The first message of a topic that was sent after a time, by default now."""
        since_s = time.monotonic() if since_s is None else since_s

        def newest() -> list[Mapping[str, Any]]:
            reported = [drone.message(topic, time.monotonic()) for drone in self._watcher.drones()]
            return [message for message in reported if message is not None and message["time_s"] > since_s]

        until(lambda: bool(newest()), f"telemetry of {topic}")
        return newest()[0]


def _told_since(time_s: float, what: str) -> float:
    """When the unit wrote something to its journal, on the monotonic clock."""
    found: list[float] = []

    def reported() -> bool:
        for line in run("journalctl", "-u", UNIT, "-b", "-o", "json", "-n", "50").splitlines():
            entry = json.loads(line)
            entry_s = 1e-6 * int(entry["__MONOTONIC_TIMESTAMP"])
            if entry_s > time_s and what in str(entry["MESSAGE"]):
                found.append(entry_s)
        return bool(found)

    until(reported, f"{what!r} in the journal", look_s=LOOK_S)
    return found[0]


def main() -> None:
    """All checks in their order."""
    findings, start = map(Path, sys.argv[1:])
    load()
    service = Service(start.read_text(encoding="utf-8"))
    run_checks(findings, service.checks)
    service.close()


if __name__ == "__main__":
    main()
