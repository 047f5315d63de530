"""The bench: propellers off, the line runs from the cameras to the gate, and nothing is sent that moves a drone."""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError
from flockd.core.messages import FloatArray, ReasonKind, Setpoint
from flockd.flight.inference.hashes import model_hashes
from flockd.flight.perception import load_networks
from flockd.flight.safety import Gate
from flockd.ground.doctor import Finding, failed, graded, passed, warned
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.daemon import Components, Daemon, InterruptibleNetworks, ServiceManager, cameras_at_once
from flockd.onboard.worker import GOLDEN_S, within

SAMPLE_S = 0.5
STEADY = 0.95
"""Least share of the steps that were due."""
GATE_PERIOD_S = 0.05
FIRST_FRAME_S = 60.0
"""Slow cameras open within ten; what has brought nothing by then brings nothing."""


class SilentLink(AutopilotLink):
    """Hears the autopilot, and asks it for messages; whatever else a daemon would send does not leave it."""

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Sends nothing."""

    async def _refused(self) -> None:
        raise AutopilotError("on the bench nothing is asked of the autopilot")

    hold = land = return_home = _refused


@dataclass(frozen=True)
class Sample:
    """How it ran at one moment."""

    time_s: float
    armed: bool
    heartbeat_age_s: float
    steps: int
    failed: int
    load: float
    """What a step takes of the time it has, 95th percentile of the last ones."""
    loop_lag_s: float
    temperature_c: float | None
    camera_age_s: Mapping[str, float]
    """Since each camera's newest usable frame."""
    camera_faults: Mapping[str, str]
    neighbours: int
    own_motion: bool
    why: str | None
    """Of the newest step, what an own motion may have failed by; None: nothing is missing."""
    command: FloatArray | None
    """(2,) m/s, north and east: what the gate would have let through."""
    stages_ms: Mapping[str, float]
    """Where the time of the newest step went."""


async def bench(
    config: DroneConfig,
    file: str,
    seconds: float,
    *,
    stop: asyncio.Event,
    on_second: Callable[[int], None] = lambda seconds: None,
    load: Callable[[], InterruptibleNetworks] | None = None,
    patience_s: float = FIRST_FRAME_S,
) -> list[Sample]:
    """Runs the daemon with a link that sends nothing, until the time is over, `stop` is set, or the drone is armed.

    Args:
        config: the drone's.
        file: its path, named in errors.
        seconds: how long, from the first frame on.
        stop: ends it early.
        on_second: called with how many seconds are over.
        load: loads the networks; None: the configured ones.
        patience_s: for the first frame, from when all else runs.

    Raises FlockdError for what cannot be opened, and where no frame comes.
    """

    daemon = Daemon(
        config,
        file,
        load_networks=load
        or (lambda: load_networks(config.perception, within(GOLDEN_S), at_once=cameras_at_once(config))),
        models=model_hashes(config.perception),
        recordings=None,
        service=ServiceManager({}),
        clock=time.monotonic,
        connect=SilentLink.connect,
    )
    running = asyncio.create_task(daemon.run())
    gate, samples = Gate(config.safety.gate), list[Sample]()
    began_s = sampled_s = late_s = math.inf
    try:
        while not running.done() and not stop.is_set():
            await asyncio.sleep(GATE_PERIOD_S)
            components, now = daemon.components, time.monotonic()
            if components is None:
                continue
            if components.pilot_loop.frames is None:
                late_s = min(late_s, now + patience_s)
                if now > late_s:
                    cameras = components.source.status().items()
                    faults = "; ".join(f"camera {name} {one.fault or 'delivers nothing'}" for name, one in cameras)
                    told = f"no images of all cameras came within {patience_s:g} s: {faults}"
                    raise UnavailableError(f"{told}; `flockd doctor` says what to do")
                continue
            if math.isinf(began_s):
                began_s, sampled_s = now, now - SAMPLE_S
            setpoint = components.control.rehearsed(gate)
            if now - sampled_s >= SAMPLE_S:
                sampled_s = now
                samples.append(_sample(components, now - began_s, None if setpoint is None else setpoint.velocity))
                on_second(int(now - began_s))
                if samples[-1].armed:
                    break
            if now - began_s >= seconds:
                break
        return samples
    finally:
        daemon.ask_to_stop()
        await asyncio.wait({running})
        if not running.cancelled() and (error := running.exception()) is not None:
            raise error


def _sample(components: Components, time_s: float, command: FloatArray | None) -> Sample:
    loop, status, cameras = components.pilot_loop, components.link.status(), components.source.status()
    output = None if loop.newest is None else loop.newest.output
    # What an own motion lacks, in the line from the input on; a height by another source than wanted is no cause.
    causes = (ReasonKind.INPUT, ReasonKind.CAMERA, ReasonKind.LENS, ReasonKind.PAIR, ReasonKind.EGO_MOTION)
    reasons = () if output is None else output.reasons
    return Sample(
        time_s=time_s,
        armed=status.armed,
        heartbeat_age_s=status.heartbeat_age_s,
        steps=loop.steps,
        failed=loop.failed,
        load=loop.load(),
        loop_lag_s=components.lag.worst_s(),
        temperature_c=components.thermometer.hottest_c,
        camera_age_s={name: camera.age_s for name, camera in cameras.items()},
        camera_faults={name: camera.fault for name, camera in cameras.items() if camera.fault is not None},
        neighbours=0 if output is None else sum(one.confirmed for one in output.neighbours),
        own_motion=output is not None and output.ego_motion is not None,
        why=next((reason.text for kind in causes for reason in reasons if reason.kind is kind), None),
        command=command,
        stages_ms={} if output is None else output.stages_ms,
    )


def judged(config: DroneConfig, samples: Sequence[Sample], seconds: float) -> Iterator[Finding]:
    """What the samples of a bench of so many seconds say."""
    if not samples:
        yield failed("bench", "no frame came, so that nothing could be run", "run `flockd doctor` first")
        return
    last = samples[-1]
    if last.armed:
        measured = f"the drone was armed after {last.time_s:.0f} s, which ended it"
        yield failed("bench", measured, "leave it disarmed; begin again")
    elif last.time_s < seconds - 2 * SAMPLE_S:
        measured = f"ended after {last.time_s:.0f} of {seconds:.0f} s"
        yield warned("bench", measured, "let it run to its end: heat takes its time")
    else:
        yield passed("bench", f"ran for {last.time_s:.0f} s without arming; nothing was sent that moves the drone")
    yield from _steps(config, samples, last.time_s)
    for camera in config.rig.cameras:
        yield _camera(camera.name, samples)
    safety = config.safety
    worst_s, limit_s = max(sample.loop_lag_s for sample in samples), safety.max_loop_lag_s
    measured = f"the control loop was late by {1e3 * worst_s:.0f} ms at worst, of {1e3 * limit_s:.0f} ms allowed"
    fix = "give the service a higher priority, and stop other programs"
    yield graded("control loop", measured, fix, failure=worst_s > limit_s)
    yield _temperature([s.temperature_c for s in samples if s.temperature_c is not None], safety.degraded_temperature_c)
    oldest_s, limit_s = max(sample.heartbeat_age_s for sample in samples), safety.heartbeat_timeout_s
    measured = f"heartbeats at most {oldest_s:.1f} s apart, {limit_s:g} s allowed"
    fix = "check the cable, its baud rate, and what else uses the port"
    yield graded("autopilot", measured, fix, failure=oldest_s > limit_s)
    yield from _what_it_saw(samples)
    speeds = [float(np.hypot(*sample.command)) for sample in samples if sample.command is not None]
    if speeds:
        measured = f"it would have flown at {np.median(speeds):.2f} m/s at the median, {max(speeds):.2f} m/s at most"
        yield passed("commands", measured)
    else:
        yield warned("commands", "none was computed", "let it run longer than two steps")


def _steps(config: DroneConfig, samples: Sequence[Sample], ran_s: float) -> Iterator[Finding]:
    steps, due, lost = samples[-1].steps, max(ran_s / config.step_s, 1.0), samples[-1].failed
    measured = f"{steps} steps, {steps / max(ran_s, config.step_s):.2f} a second of {1 / config.step_s:.2f} configured"
    if lost:
        yield failed("steps", f"{measured}; {lost} had no result", "read the events above; run `flockd models verify`")
    else:
        fix = "give flockd more of the computer, or a longer step_s"
        yield graded("steps", measured, fix, warning=steps < STEADY * due)
    loads = np.array([sample.load for sample in samples if sample.steps])
    if not len(loads):
        return
    gone, slow = loads.max() > config.safety.max_load, loads.max() > config.safety.degraded_load
    what = ": it would have handed over to the autopilot" if gone else ": it would have slowed down" if slow else ""
    measured = f"a step takes {100 * np.median(loads):.0f} % of its time, at worst {100 * loads.max():.0f} %{what}"
    fix = "stop other programs, cool the computer, use fewer or smaller images, or a longer step_s"
    yield graded("load", measured, fix, failure=gone, warning=slow)
    stages = {stage: [s.stages_ms[stage] for s in samples if stage in s.stages_ms] for stage in samples[-1].stages_ms}
    spread = {stage: np.percentile(taken_ms, (50, 95)) for stage, taken_ms in stages.items()}
    longest = sorted(spread, key=lambda stage: -spread[stage][0])
    if longest:
        shown = ", ".join(f"{stage} {spread[stage][0]:.0f} / {spread[stage][1]:.0f}" for stage in longest)
        yield passed("stages", f"ms, median / 95th percentile: {shown}")


def _camera(name: str, samples: Sequence[Sample]) -> Finding:
    ages_s = [age for s in samples if math.isfinite(age := s.camera_age_s.get(name, math.inf))]
    faults = list(dict.fromkeys(s.camera_faults[name] for s in samples if name in s.camera_faults))
    told = faults
    if ages_s:
        told = [f"newest frame {1e3 * np.median(ages_s):.0f} ms old, at worst {1e3 * max(ages_s):.0f} ms", *faults]
    fix = "run `flockd doctor --only cameras --seconds 60`; check its cable"
    return graded(f"camera {name}", "; ".join(told) or "no frame came", fix, failure=bool(faults) or not ages_s)


def _temperature(known_c: Sequence[float], limit_c: float) -> Finding:
    if not known_c:
        fix = "load the driver of its thermal sensor, if it has one"
        return warned("temperature", "this computer reports none", fix)
    measured = f"{known_c[0]:.0f} °C at the start, {max(known_c):.0f} at most, {known_c[-1]:.0f} at the end"
    fix = "improve its airflow, or add a heat sink"
    return graded("temperature", f"{measured}; limit {limit_c:g}", fix, warning=max(known_c) >= limit_c)


def _what_it_saw(samples: Sequence[Sample]) -> Iterator[Finding]:
    most = max(sample.neighbours for sample in samples)
    share = sum(sample.neighbours > 0 for sample in samples) / len(samples)
    what = "neighbour" if most == 1 else "neighbours"
    measured = f"{most} {what} at most, one or more in {100 * share:.0f} % of the time" if most else "none were seen"
    fix = "where no drone was to be seen, they are false: look at them with `flockd detect` or `flockd report`"
    yield graded("neighbours", measured, fix, warning=most > 0)
    known = sum(sample.own_motion for sample in samples) / len(samples)
    measured = f"estimated in {100 * known:.0f} % of the time"
    whys = Counter(sample.why for sample in samples if not sample.own_motion and sample.why is not None)
    if known < STEADY and whys:
        measured += f"; mostly: {whys.most_common(1)[0][0]}"
    fix = "show the cameras something with texture, in light; without a range finder lift the drone after its start"
    yield graded("own motion", measured, fix, warning=known < STEADY)
