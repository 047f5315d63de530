"""Recordings with damage, and with changes behind correct checksums."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from random import Random

from flockd.onboard.recording.mcap_file import Damage, Entry, Inclosure, McapFile, Note, Record, read_records
from flockd.onboard.recording.reader import Recording, recording_info
from tests.hostile import CORPUS, hostile, mutated_bytes, mutated_json, nested, odd_file, own_errors, removed


def test_a_changed_recording_is_read_or_refused(tmp_path: Path) -> None:
    whole = (CORPUS / "recording.mcap").read_bytes()
    records = [record for record in read_records(CORPUS / "recording.mcap") if not isinstance(record, Damage)]
    file = tmp_path / "mutated.mcap"

    @hostile(25)
    def check(random: Random) -> None:
        removed(file)
        if random.random() < 0.01:
            odd_file(random, file)
        elif random.random() < 0.3:
            file.write_bytes(mutated_bytes(random, whole))
        else:
            with McapFile(file) as written:
                for record in _changed(random, records):
                    written.write(record)
        with own_errors():
            recording = Recording(file)
            json.dumps(recording_info(recording), allow_nan=False)
            for _ in recording.steps():
                pass

    check()


def _changed(random: Random, records: Sequence[Record]) -> list[Record]:
    """Records with some changed inside, dropped, doubled or out of order: what a checksum does not notice."""
    changed = list(records)
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(changed))
        match random.randrange(6):
            case 0:
                del changed[at]
            case 1:
                changed.insert(random.randrange(len(changed)), changed[at])
            case _:
                changed[at] = _changed_inside(random, changed[at])
    return changed


def _changed_inside(random: Random, record: Record) -> Record:
    match record:
        case Note():
            facts = mutated_json(random, dict(record.facts))
            facts = facts if isinstance(facts, dict) else {}
            return Note(record.name, {str(key): _writable(str(value)) for key, value in facts.items()})
        case Inclosure():
            return dataclasses.replace(record, data=_changed_json(random, record.data))
        case Entry() if random.random() < 0.2:
            return dataclasses.replace(record, sequence=random.choice((0, 1, 2, 2**32 - 1)))
        case Entry() if random.random() < 0.1:
            topic = random.choice(("/../../x", "/x/../image", "/camera/../image", "", "/", "/\x1b/image", "/frames"))
            return dataclasses.replace(record, stream=dataclasses.replace(record.stream, topic=topic))
        case Entry() if record.stream.encoding == "json":
            return dataclasses.replace(record, data=_changed_json(random, record.data))
    return dataclasses.replace(record, data=mutated_bytes(random, record.data))


def _writable(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def _changed_json(random: Random, data: bytes) -> bytes:
    if random.random() < 0.1:
        return mutated_bytes(random, data)
    if random.random() < 0.02:
        return nested(random)
    try:
        changed = mutated_json(random, json.loads(data))
    except (ValueError, RecursionError):  # changed before
        return data
    return json.dumps(changed).encode("utf-8", "surrogatepass")
