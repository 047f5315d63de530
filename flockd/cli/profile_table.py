"""How `flockd replay --profile` says where time goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flockd.cli.output import say


def say_profile(profile: Mapping[str, Any]) -> None:
    """A table of stages, the computer, and the step time that it can keep; ``profile`` as `profile_result` gives it."""
    say(f"\n{'stage':<20}{'p50 ms':>8}{'p95 ms':>8}{'share':>8}")
    for stage, row in profile["stages"].items():
        say(f"{stage:<20}{row['p50_ms']:>8.1f}{row['p95_ms']:>8.1f}{100 * row['share']:>7.0f}%")
    say(f"\n{_computer(profile['computer'])}")
    say(_instructions(profile["computer"]))
    cameras = ", ".join(f"{name} {width}x{height}" for name, (width, height) in profile["cameras"].items())
    say(f"cameras: {cameras}")
    say(f"networks: {', '.join(profile['networks'])} on {profile['provider']}, perception.threads {profile['threads']}")
    say(f"a step takes {profile['processor_ms']:.0f} ms of processor time: {profile['cores_busy']:.1f} cores busy")
    say(f"memory: {profile['memory_mb']:.0f} MB at most; load before: {profile['load_before']:.1f}")
    say(f"temperature: {_temperature(profile)}")
    say("; ".join(f"{name} {version}" for name, version in profile["versions"].items()))
    say(f"\n{_advice(profile)}")


def _computer(computer: Mapping[str, Any]) -> str:
    memory = "" if computer["memory_mb"] is None else f", {computer['memory_mb'] / 1e3:.1f} GB of memory"
    cores = computer["cores"]
    return (
        f"computer: {computer['name']}, {computer['architecture']}, {cores} {'core' if cores == 1 else 'cores'}{memory}"
    )


def _instructions(computer: Mapping[str, Any]) -> str:
    eight_bit = ", ".join(computer["eight_bit"]) or "none known, so the 8-bit networks save little"
    return f"instructions for 8-bit numbers: {eight_bit}; others: {', '.join(computer['vector']) or 'none known'}"


def _temperature(profile: Mapping[str, Any]) -> str:
    if profile["temperature_c"] is None:
        text = "this computer reports none"
    else:
        start, most, end = profile["temperature_c"]
        text = f"{start:.0f} °C at the start, {most:.0f} at most, {end:.0f} at the end ({profile['zone']})"
    if profile["clock_mhz"] is not None:
        text += "; clock {:.0f} to {:.0f} MHz".format(*profile["clock_mhz"])
    if profile["slowed_by"]:
        text += f"; THE PROCESSOR WAS SLOWED DOWN ({', '.join(profile['slowed_by'])}): cool it, and measure again"
    return text


def _advice(profile: Mapping[str, Any]) -> str:
    share = 100 * profile["stages"]["step"]["p95_ms"] / (1e3 * profile["step_s"])
    text = f"step_s {profile['step_s']:g} is configured: a step takes {share:.0f} % of it (p95)"
    least = profile["least_step_s"]
    if least > profile["step_s"]:
        return f"{text}. Too long: configure step_s: {least:g} or more here"
    return f"{text}. The least that leaves a fifth for cameras, recording and telemetry: step_s: {least:g}"
