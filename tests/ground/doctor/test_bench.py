"""The bench: a whole daemon with a fake autopilot and frames runs, sends nothing, and its report says how it ran."""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.errors import UnavailableError
from flockd.ground.doctor import Level
from flockd.ground.doctor.bench import Sample, bench, judged
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.ports import free_endpoint, free_port
from tests.onboard.daemon.aboard import CAMERAS, Cameras, TinyPerceiver, config_for

CONFIG = config_for(14540, "tcp/127.0.0.1:1", "tcp/127.0.0.1:2")
"""Of the judgements: a step each 0.25 s, two cameras."""
WELL = Sample(
    time_s=0.0, armed=False, heartbeat_age_s=0.4, steps=0, failed=0, load=0.5, loop_lag_s=0.01, temperature_c=50.0,
    camera_age_s={"front": 0.05, "back": 0.05}, camera_faults={}, neighbours=0, own_motion=True, why=None,
    command=np.array([0.3, 0.4]), stages_ms={"scene": 60.0, "flow": 90.0},
)  # fmt: skip


def samples(seconds: float = 60.0) -> list[Sample]:
    """One a second, each a degree hotter for 20 s, with four steps a second."""
    return [
        replace(WELL, time_s=float(s), steps=4 * s, temperature_c=50.0 + min(s, 20)) for s in range(int(seconds) + 1)
    ]


async def test_the_whole_line_runs_and_nothing_that_moves_a_drone_is_sent() -> None:
    port, frames = free_port(), free_endpoint()
    config = config_for(port, frames, free_endpoint())
    cameras = Cameras(frames)
    try:
        with FakeAutopilot(port, heartbeat_s=0.25) as autopilot:
            seen = await bench(config, "tiny.yaml", 2.0, stop=asyncio.Event(), load=TinyPerceiver)
            assert not autopilot.setpoints
            assert not autopilot.armed
            assert autopilot.mode == "LOITER"
            assert not any(one.armed for one in seen)
            assert seen[-1].steps >= 2
            assert set(seen[-1].camera_age_s) == {"front", "back"}
            commands = [one.command for one in seen if one.command is not None]
            assert commands, "what the gate would have let through"
            assert max(float(np.hypot(*command)) for command in commands) > 0.0
            found = list(judged(config, seen, 2.0))
            assert [one.about for one in found][:4] == ["bench", "steps", "load", "stages"]

            autopilot.pilot_arms()
            stopped = await bench(config, "tiny.yaml", 60.0, stop=asyncio.Event(), load=TinyPerceiver)
            assert stopped[-1].armed
            assert stopped[-1].time_s < 30.0
            assert not autopilot.setpoints
            assert next(judged(config, stopped, 60.0)).level is Level.FAILURE
    finally:
        cameras.close()


def test_a_drone_that_flies_offboard_already_gets_no_setpoint_from_the_bench() -> None:
    """Armed, in the air and with offboard selected: a daemon would fly or ask for Hold."""

    async def story() -> None:
        port, frames = free_port(), free_endpoint()
        cameras = Cameras(frames)
        try:
            with FakeAutopilot(port, height_m=3.0, heartbeat_s=0.25) as autopilot:
                autopilot.pilot_selects("OFFBOARD")
                seen = await bench(
                    config_for(port, frames, free_endpoint()), "t", 5.0, stop=asyncio.Event(), load=TinyPerceiver
                )
                assert seen[-1].armed
                assert not autopilot.setpoints
        finally:
            cameras.close()

    asyncio.run(story())


def test_a_good_run_passes_with_its_figures() -> None:
    found = {one.about: one for one in judged(CONFIG, samples(), 60.0)}
    assert {one.level for one in found.values()} == {Level.PASS}
    assert found["steps"].measured == "240 steps, 4.00 a second of 4.00 configured"
    assert found["load"].measured == "a step takes 50 % of its time, at worst 50 %"
    assert found["stages"].measured == "ms, median / 95th percentile: flow 90 / 90, scene 60 / 60"
    assert found["camera back"].measured == "newest frame 50 ms old, at worst 50 ms"
    assert found["temperature"].measured == "50 °C at the start, 70 at most, 70 at the end; limit 85"
    assert found["autopilot"].measured.startswith("heartbeats at most 0.4 s apart")
    assert found["commands"].measured == "it would have flown at 0.50 m/s at the median, 0.50 m/s at most"


@pytest.mark.parametrize(
    ("wrong", "about", "level", "told"),
    [
        ({"failed": 2}, "steps", Level.FAILURE, "2 had no result"),
        ({"steps": 120}, "steps", Level.WARNING, "120 steps, 2.00 a second of 4.00 configured"),
        ({"load": 60.0}, "load", Level.WARNING, "it would have slowed down"),
        ({"load": 120.0}, "load", Level.FAILURE, "it would have handed over to the autopilot"),
        ({"loop_lag_s": 3.0}, "control loop", Level.FAILURE, "late by 3000 ms at worst"),
        ({"temperature_c": 90.0}, "temperature", Level.WARNING, "90 at most"),
        ({"heartbeat_age_s": 9.0}, "autopilot", Level.FAILURE, "heartbeats at most 9.0 s apart"),
        ({"neighbours": 1}, "neighbours", Level.WARNING, "1 neighbour at most, one or more in 2 % of the time"),
        (
            {"camera_faults": {"back": "delivers no frames; check its cable"}},
            "camera back",
            Level.FAILURE,
            "delivers no",
        ),
        ({"armed": True}, "bench", Level.FAILURE, "the drone was armed after 60 s"),
    ],
)
def test_what_was_wrong_at_the_end_is_told(wrong: dict[str, object], about: str, level: Level, told: str) -> None:
    seen = samples()
    seen[-1] = replace(seen[-1], **wrong)  # type: ignore[arg-type]
    (finding,) = (one for one in judged(CONFIG, seen, 60.0) if one.about == about)
    assert finding.level is level
    assert told in finding.measured


async def test_a_drone_at_the_height_of_its_start_knows_no_motion_and_says_why() -> None:
    """Without a range finder its height is 0 on the bench, unless it is lifted after its start."""
    port, frames = free_port(), free_endpoint()
    config = config_for(port, frames, free_endpoint(), own_velocity="vision")
    config = config.model_copy(update={"perception": config.perception.model_copy(update={"scale": "height"})})
    cameras = Cameras(frames)
    try:
        with FakeAutopilot(port, heartbeat_s=0.25):
            seen = await bench(config, "tiny.yaml", 2.0, stop=asyncio.Event(), load=TinyPerceiver)
    finally:
        cameras.close()
    (finding,) = (one for one in judged(config, seen, 2.0) if one.about == "own motion")
    assert finding.level is Level.WARNING
    assert finding.measured.startswith("estimated in 0 % of the time; mostly: camera ")
    assert finding.measured.endswith("is not above the ground: its height is 0.00 m")
    assert "lift the drone after its start" in finding.fix


def test_a_run_without_frames_and_one_that_was_ended_say_so() -> None:
    (nothing,) = judged(CONFIG, [], 60.0)
    assert (nothing.level, nothing.measured) == (Level.FAILURE, "no frame came, so that nothing could be run")
    first = next(judged(CONFIG, samples(30.0), 600.0))
    assert (first.level, first.measured) == (Level.WARNING, "ended after 30 of 600 s")
    silent = [replace(one, camera_age_s={"front": 0.05, "back": math.inf}) for one in samples()]
    assert "no frame came" in {one.about: one.measured for one in judged(CONFIG, silent, 60.0)}["camera back"]


async def test_where_no_frame_comes_it_ends_and_says_of_which_camera() -> None:
    port, frames = free_port(), free_endpoint()
    config = config_for(port, frames, free_endpoint())
    cameras = Cameras(frames)
    cameras.silent = set(CAMERAS)
    try:
        with (
            FakeAutopilot(port, heartbeat_s=0.25),
            pytest.raises(
                UnavailableError, match=r"no images .* within 0\.5 s: camera front .*; camera back "
            ) as caught,
        ):
            await bench(config, "tiny.yaml", 600.0, stop=asyncio.Event(), load=TinyPerceiver, patience_s=0.5)
    finally:
        cameras.close()
    assert "`flockd doctor` says" in str(caught.value)


def test_the_command_runs_it_and_ends_with_what_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port, frames = free_port(), free_endpoint()
    config = config_for(port, frames, free_endpoint())
    monkeypatch.setattr("flockd.ground.doctor.bench.load_networks", lambda *_, **__: TinyPerceiver())
    monkeypatch.setattr("flockd.cli.doctor.load_to_fly", lambda file, force: config)
    cameras = Cameras(frames)
    try:
        with FakeAutopilot(port, heartbeat_s=0.25) as autopilot:
            code = main(["doctor", "--config", "tiny.yaml", "--bench", "--minutes", "0.03", "--json"])
            assert not autopilot.setpoints
    finally:
        cameras.close()
    told = json.loads(capsys.readouterr().out)
    assert code in {0, 1}
    assert {row["check"] for row in told["findings"]} == {"bench"}
    assert {"steps", "camera front", "autopilot", "commands"} <= {row["about"] for row in told["findings"]}
    for options in (["--minutes", "1"], ["--bench", "--only", "disk"]):
        assert main(["doctor", "--config", "tiny.yaml", *options]) == 2
