"""What a kill leaves can be played, and what is not ours is refused."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from flockd.cli import main
from flockd.onboard.recording import Recorder, RecordingError
from flockd.onboard.recording.mcap_file import Damage, Entry, Inclosure, McapFile, Record, read_records
from flockd.onboard.recording.reader import Recording
from flockd.onboard.recording.recorder import FLUSH_EVERY_S
from flockd.onboard.recording.streams import is_image
from tests.calm import until
from tests.onboard.recording.made_up import LEARNED, MadeUpPilot, drone_config, inputs, record, rewritten, with_facts

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "drone1.mcap"
    record(path)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(RecordingError) as caught:
        Recording(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    return str(caught.value).removeprefix(f"{path}: ")


def test_what_is_no_recording_is_refused_in_one_sentence(tmp_path: Path, whole: Path) -> None:
    path = tmp_path / "x.mcap"
    assert "does not exist; " in refusal(path)
    assert "is a folder; " in refusal(tmp_path)
    for content in (b"", b"hello", b"\x89MCAP"):
        path.write_bytes(content)
        assert "is not a recording (" in refusal(path)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/speed", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    assert "is an MCAP file, but not a recording of flockd; " in refusal(path)
    content = whole.read_bytes()
    path.write_bytes(content.replace(b"\x01\x00\x00\x001", b"\x01\x00\x00\x002", 1))
    assert "is of format '2', and this flockd reads '1'; " in refusal(path)
    for number, fact in enumerate(({"drone": "../../x"}, {"drone": ""}, {"images": ""})):
        changed = with_facts(whole, tmp_path / f"{number}.mcap", **fact)
        assert f"names no {next(iter(fact))} in its note of the flight; " in refusal(changed)


def test_recordings_that_were_joined_are_not_taken_for_one_flight(tmp_path: Path, whole: Path) -> None:
    """By `mcap merge`, which sorts all messages by time, and by `cat`."""
    found = [record for record in read_records(whole) if not isinstance(record, Damage)]
    with McapFile(tmp_path / "merged.mcap") as merged:
        for one in sorted(found * 2, key=lambda one: one.time_ns if isinstance(one, Entry) else 0):
            merged.write(one)
    assert "step 0 comes behind step 0, as in recordings that were joined; " in refusal(merged.path)
    content = whole.read_bytes()
    (tmp_path / "cat.mcap").write_bytes(2 * content)
    (damage,) = Recording(tmp_path / "cat.mcap").contents.damages
    assert (damage.offset, damage.at_end) == (len(content), False)
    assert f"{len(content):,} bytes, as of a second file, follow its end" in damage.reason


def test_images_that_the_rig_does_not_have_are_refused(tmp_path: Path, whole: Path) -> None:
    """The rig's are of 160 x 120 pixels, its cameras front and left."""
    for key, other, fault in (("name", "top", "no such camera"), ("size_px", [320, 240], "has it with 320 x 240")):

        def changed(found: Record, key: str = key, other: object = other) -> Record:
            if not isinstance(found, Inclosure):
                return found
            config = json.loads(found.data)
            config["rig"]["cameras"][0] |= {key: other}
            config["rig"]["cameras"][0]["intrinsics"] |= {"cx": 160.0, "cy": 120.0} if key == "size_px" else {}
            return replace(found, data=json.dumps(config).encode())

        recording = Recording(rewritten(whole, tmp_path / f"{key}.mcap", changed))
        with pytest.raises(RecordingError, match=f"step 0 .*camera front has 160 x 120 pixels, and its rig .*{fault}"):
            list(recording.steps())


def test_what_the_pilot_began_with_of_the_others_size_comes_back_to_the_last_bit(tmp_path: Path, whole: Path) -> None:
    assert Recording(whole).learned == LEARNED
    record(tmp_path / "x.mcap", learned=None)
    assert Recording(tmp_path / "x.mcap").learned is None


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{", "cannot be read (Expecting property name enclosed in double quotes: line 1 column 2 (char 1))"),
        ("[]", "cannot be read"),
        ('{"size_m": 0.4}', "cannot be read"),
        ('{"size_m": 0.4, "sigma": "NaN"}', "is no size"),
        ('{"size_m": -0.4, "sigma": 0.1}', "is no size"),
    ],
)
def test_a_size_that_is_none_is_refused(text: str, fault: str, tmp_path: Path, whole: Path) -> None:
    path = with_facts(whole, tmp_path / "x.mcap", learned_size=text)
    assert refusal(path).startswith(f"its learned_size {fault}")


def test_a_recording_of_another_version_is_read_and_names_what_this_one_does_not_know(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def later(entry: Record) -> Record:
        if not isinstance(entry, Inclosure):
            return entry
        values = json.loads(entry.data)
        return replace(entry, data=json.dumps(values | {"colour": "red", "yaw": "sideways"}).encode())

    path = with_facts(rewritten(whole, tmp_path / "later.mcap", later), tmp_path / "x.mcap", version="9.1")
    recording = Recording(path)
    assert set(recording.unknown) == {"colour", "yaw"}
    assert recording.config == Recording(whole).config
    assert main(["record", "info", str(path)]) == 0
    assert f"warning: {path}: this flockd does not know" in capsys.readouterr().err
    assert main(["replay", str(path)]) == 1
    assert "a replay would be another flight; use 9.1 that wrote it" in capsys.readouterr().err


def test_a_configuration_that_lacks_what_no_default_gives_is_refused_with_the_version_that_reads_it(
    tmp_path: Path, whole: Path
) -> None:
    def without_rig(entry: Record) -> Record:
        return replace(entry, data=b"{}") if isinstance(entry, Inclosure) else entry

    told = refusal(with_facts(rewritten(whole, tmp_path / "x.mcap", without_rig), tmp_path / "y.mcap", version="9.1"))
    assert told.startswith("the configuration in it is not one of this flockd (rig: ")
    assert told.endswith("); use the flockd that wrote it, 9.1")


def test_a_file_cut_off_anywhere_is_refused_or_played_as_far_as_it_goes(tmp_path: Path, whole: Path) -> None:
    content = whole.read_bytes()
    path = tmp_path / "drone1.mcap"
    outcomes = []
    for length in np.linspace(8, len(content) - 1, 120).astype(int):
        path.write_bytes(content[:length])
        try:
            recording = Recording(path)
        except RecordingError as error:
            assert "\n" not in str(error)
            outcomes.append(0)
        else:
            steps = list(recording.steps())
            assert not recording.contents.finished or len(steps) == 10, "only its index is cut off"
            assert [step.number for step in steps] == list(range(len(steps)))
            outcomes.append(len(steps))
    assert outcomes == sorted(outcomes)
    assert (outcomes[0], outcomes[-1]) == (0, 10)


@pytest.mark.fault("hostile-recording")
def test_damage_within_is_reported_and_costs_the_steps_that_it_hit(tmp_path: Path, whole: Path) -> None:
    content = bytearray(whole.read_bytes())
    at = len(content) // 2
    content[at : at + 2000] = bytes(2000)
    path = tmp_path / "drone1.mcap"
    path.write_bytes(content)
    damaged = Recording(path)
    (damage,) = damaged.contents.damages
    assert at - 200_000 < damage.offset <= at
    assert not damage.at_end
    numbers = [step.number for step in damaged.steps()]
    assert 7 <= len(numbers) <= 9
    (lost,) = {number - place for place, number in enumerate(numbers)} - {0}
    assert lost == 10 - len(numbers), "one stretch is missing"


def _chunk(compression: str, uncompressed_size: int, data: bytes) -> bytes:
    """As the MCAP specification writes a chunk: times, size, no checksum, compression, data."""
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, uncompressed_size, 0, len(name)) + name + struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


_BOMB = zstandard.compress(b"\0" * (300 << 20))
_LZ4 = lz4.frame.compress(bytes(range(256)) * 100)


@pytest.mark.fault("hostile-recording")
@pytest.mark.parametrize(
    ("record_bytes", "reason"),
    [
        (_chunk("zstd", 3 << 30, _BOMB), "3,221,225,472 bytes uncompressed"),
        (_chunk("zstd", 1000, _BOMB), "uncompressed size"),
        (_chunk("zstd", (1 << 63) + 5, b"x"), "bytes uncompressed"),
        (_chunk("lz4", 25600, _LZ4[:200]), "uncompressed size"),
        (_chunk("lz4", 25600, b"no lz4 at all"), "chunk"),
        (_chunk("", 9, struct.pack("<BQ", 5, (1 << 63) + 1)), "chunk"),
        (_chunk("brotli", 9, b"x"), "chunk"),
    ],
)
def test_a_hostile_chunk_is_damage_and_takes_little_memory(
    tmp_path: Path, whole: Path, record_bytes: bytes, reason: str
) -> None:
    content = whole.read_bytes()
    end = content.rindex(struct.pack("<BQ", 15, 4))  # DATA_END: a checksum of 4 bytes
    path = tmp_path / "x.mcap"
    path.write_bytes(content[:end] + record_bytes + content[end:])
    tracemalloc.start()
    (damage,) = [record for record in read_records(path) if isinstance(record, Damage)]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert reason in damage.reason
    assert not damage.at_end
    assert peak < 100 << 20
    assert len(list(Recording(path).steps())) == len(list(Recording(whole).steps()))


@pytest.mark.fault("huge-image")
def test_an_image_that_claims_to_be_huge_is_not_decoded(tmp_path: Path, whole: Path) -> None:
    """A PNG's width and height are bytes 16 to 24; zlib packs an all-black image of 60000x60000 into some megabytes."""

    def huge(entry: Record) -> Record:
        if not (isinstance(entry, Entry) and is_image(entry.stream.topic)):
            return entry
        at = entry.data.index(b"IHDR") + 4
        head = b"IHDR" + struct.pack(">II", 60000, 60000) + entry.data[at + 8 : at + 13]
        whole_head = head + struct.pack(">I", zlib.crc32(head))
        return replace(entry, data=entry.data[: at - 4] + whole_head + entry.data[at + 17 :])

    with pytest.raises(RecordingError, match="a png image does not decode"):
        list(Recording(rewritten(whole, tmp_path / "x.mcap", huge)).steps())


@pytest.mark.fault("hostile-recording")
@pytest.mark.parametrize("topic", ["/vehicle", "/output"])
@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b"[1]", b"[" * 100_000], ids=["none", "open", "utf8", "list", "deep"]
)
def test_a_step_with_a_damaged_message_is_named(tmp_path: Path, whole: Path, topic: str, data: bytes) -> None:
    """Behind a checksum that is right."""

    def damaged(one: Record) -> Record:
        hit = isinstance(one, Entry) and one.stream.topic == topic and one.sequence == 1
        return replace(one, data=data) if hit else one  # type: ignore[arg-type]

    recording = Recording(rewritten(whole, tmp_path / "x.mcap", damaged))
    if (topic, data) == ("/output", b"[1]"):  # an output is only compared, not flown
        assert len(list(recording.steps())) == 10
        return
    with pytest.raises(RecordingError, match="step 1 cannot be read "):
        list(recording.steps())


@pytest.mark.parametrize("number", ["NaN", "-1", "1e9", "9" * 5000, ""])
def test_a_number_of_lost_steps_that_is_none_is_refused(tmp_path: Path, whole: Path, number: str) -> None:
    assert "which is no number" in refusal(with_facts(whole, tmp_path / "x.mcap", lost=number))


def test_a_step_without_its_vehicle_is_the_last_of_a_killed_one_or_an_error(tmp_path: Path, whole: Path) -> None:
    records = [record for record in read_records(whole) if not isinstance(record, Damage)]
    vehicles = [n for n, r in enumerate(records) if isinstance(r, Entry) and r.stream.topic == "/vehicle"]
    killed = McapFile(tmp_path / "killed.mcap")
    for written in records[: vehicles[-1]]:
        killed.write(written)
    killed.flush()
    killed.abandon()
    assert [step.number for step in Recording(killed.path).steps()] == list(range(9))
    with McapFile(tmp_path / "odd.mcap") as odd:
        for number, written in enumerate(records):
            if number != vehicles[4]:
                odd.write(written)
    with pytest.raises(RecordingError, match="step 4 lost its message '/vehicle'"):
        list(Recording(odd.path).steps())


@pytest.mark.parametrize("off_s", [-4000.0, 1e9, math.nan])
@pytest.mark.parametrize(("topic", "what"), [("/vehicle", "the state of the vehicle"), ("/frames", "camera front")])
def test_images_and_states_of_another_time_than_their_step_are_refused(
    off_s: float, topic: str, what: str, tmp_path: Path, whole: Path
) -> None:
    def changed(one: Record) -> Record:
        if not (isinstance(one, Entry) and one.stream.topic == topic and one.sequence == 4):
            return one
        message = json.loads(one.data)
        for timed in message.get("frames", [message]):
            timed["time_s"] = timed["time_s"] + off_s if math.isfinite(off_s) else None
        return replace(one, data=json.dumps(message).encode())

    recording = Recording(rewritten(whole, tmp_path / "off.mcap", changed))
    with pytest.raises(RecordingError, match=f"step 4 cannot be read .*{what} is of "):
        list(recording.steps())


def test_what_is_in_a_step_twice_is_refused_and_not_chosen_from(tmp_path: Path, whole: Path) -> None:
    def doubled(one: Record) -> Record:
        if not (isinstance(one, Entry) and one.stream.topic == "/frames" and one.sequence == 1):
            return one
        step = json.loads(one.data)
        return replace(one, data=json.dumps({**step, "frames": [*step["frames"], step["frames"][0]]}).encode())

    listed = Recording(rewritten(whole, tmp_path / "listed.mcap", doubled))
    with pytest.raises(RecordingError, match="step 1 lists a camera twice; "):
        list(listed.steps())
    for topic in ("/vehicle", "/camera/left/image"):
        with McapFile(tmp_path / f"{topic.replace('/', '')}.mcap") as file:
            for one in read_records(whole):
                assert not isinstance(one, Damage)
                is_hit = isinstance(one, Entry) and one.stream.topic == topic and one.sequence == 2
                for _ in range(1 + is_hit):
                    file.write(one)
        with pytest.raises(RecordingError, match=f"step 2 has two messages of {topic}; "):
            list(Recording(file.path).steps())


def _of_now(file: Path) -> Recording | None:
    """What a kill would leave of it now; None: no step yet."""
    copy = file.with_name("killed.mcap")
    copy.write_bytes(file.read_bytes())
    try:
        return Recording(copy)
    except RecordingError:
        return None


@pytest.mark.fault("killed-while-recording")
def test_a_kill_loses_no_more_than_was_recorded_since_the_last_flush(tmp_path: Path) -> None:
    """What is on the disk half a second after a step, though too little to be written for its size."""
    config = drone_config()
    ((frames, vehicle),) = inputs(1, levels=1)
    with Recorder(tmp_path / "flight.mcap", drone="drone1", config=config) as recorder:
        recorder.step(frames, vehicle, MadeUpPilot(config).step(frames, vehicle))
        recorder.drain()
        killed = until(lambda: _of_now(tmp_path / "flight.mcap"))
    assert not killed.contents.finished
    assert len(list(killed.steps())) == 1
    assert FLUSH_EVERY_S <= 0.5
