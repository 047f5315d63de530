"""A file that is written for long: its index takes little memory, and is all there at the end."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

from mcap.reader import make_reader

from flockd.onboard.recording.mcap_file import Entry, McapFile, Stream

CHUNKS, TOPICS = 400, 12
STREAMS = tuple(Stream(f"/topic/{number}", "json", "x", b"{}") for number in range(TOPICS))


def test_an_hour_of_chunks_takes_four_megabytes_and_the_index_still_finds_each(tmp_path: Path) -> None:
    """Five chunks a second are 18,000 an hour. MCAP's own reader seeks by the index."""
    file = McapFile(tmp_path / "long.mcap")
    tracemalloc.start()
    for number in range(CHUNKS):
        if number == CHUNKS // 2:
            before = tracemalloc.get_traced_memory()[0]
        for stream in STREAMS:
            file.write(Entry(stream, number, number, b"{}"))
        file.flush()
    taken = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert taken / (CHUNKS / 2) * 18_000 < 8e6, "half of a list's growth may be spare room"
    file.finish()
    with file.path.open("rb") as opened:
        reader = make_reader(opened)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == CHUNKS
        found = [message.log_time for _, _, message in reader.iter_messages(starting_at=390, ending_before=392)]
    assert found == [390] * TOPICS + [391] * TOPICS
