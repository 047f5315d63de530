"""Files: configurations, manifests, recordings, data sets, images, campaigns."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

import cv2
import numpy as np

from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.flight_table import FlightTable, write_table
from flockd.campaign.folder import FLIGHTS_NAME, PLAN_NAME, TIMINGS_NAME, CampaignFolder
from flockd.campaign.results import Results
from flockd.core.config import load_with_places
from flockd.flight.geometry import build_rig
from flockd.flight.inference import read_manifest
from flockd.flight.perception.requirements import check_roles
from flockd.ground.datasets import open_dataset
from flockd.ground.datasets.image_files import read_image
from flockd.onboard.recording.editing import recover
from flockd.onboard.recording.export import export_images, export_tables
from flockd.onboard.recording.info import recording_info
from flockd.onboard.recording.mcap_file import Damage, Entry, Inclosure, McapFile, Note, Record, read_records
from flockd.onboard.recording.reader import Recording
from tools.checks.fuzzing.mutation import mutated_bytes, mutated_json, mutated_lines, nested
from tools.checks.fuzzing.target import CORPUS, ROOT, Check, Target, odd_file, own_errors, removed

MOST_FRAMES = 50
"""Read of a mutated data set."""


def _text(random: Random, texts: Sequence[str]) -> bytes:
    """One of them, with lines or bytes changed."""
    text = random.choice(texts)
    if random.random() < 0.7:
        text = mutated_lines(random, text)
    data = text.encode("utf-8", "surrogatepass")
    return mutated_bytes(random, data) if random.random() < 0.4 else data


def _put(random: Random, path: Path, content: Callable[[], bytes]) -> None:
    """Now and then something else than a file, or deep nesting in one."""
    removed(path)
    odd = random.random()
    if odd < 0.01:
        odd_file(random, path)
    else:
        path.write_bytes(nested(random) if odd < 0.02 else content())


def _configurations(folder: Path) -> Check:
    shutil.copytree(ROOT / "config", folder, dirs_exist_ok=True)
    small = [path.read_text(encoding="utf-8") for path in sorted(CORPUS.glob("*.yaml"))]
    shipped = [path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.yaml"))]
    texts = [*small * 4, *shipped]  # the large ones are parsed slowly
    file = folder / "mutated.yaml"

    def check(random: Random) -> None:
        _put(random, file, lambda: _text(random, texts))
        with own_errors():
            config, _ = load_with_places(file)
            drone = config.drone if hasattr(config, "drone") else config
            build_rig(drone.rig)

    return check


def _manifests(folder: Path) -> Check:
    texts = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "models").glob("*.yaml"))]
    for name in {line.partition(": ")[2] for text in texts for line in text.splitlines() if line.startswith("file: ")}:
        (folder / name).write_bytes(b"no network")
    file = folder / "mutated.yaml"

    def check(random: Random) -> None:
        _put(random, file, lambda: _text(random, texts))
        with own_errors():
            read_manifest(file, check_roles).check_model()

    return check


def _recordings(folder: Path) -> Check:
    whole = (CORPUS / "recording.mcap").read_bytes()
    records = [record for record in read_records(CORPUS / "recording.mcap") if not isinstance(record, Damage)]
    file, copied, tables = folder / "mutated.mcap", folder / "copied.mcap", folder / "tables"
    (tables / "csv").mkdir(parents=True)

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
        with own_errors():
            recover(Recording(file), copied)
            export_tables(Recording(copied), tables / "csv", "csv")
            export_images(Recording(copied), tables / "images")
        assert {path.name for path in tables.iterdir()} <= {"csv", "images"}, "written outside of its folder"
        assert {path.name for path in folder.iterdir()} <= {file.name, copied.name, tables.name}, "written outside"

    return check


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


def _datasets(folder: Path) -> Check:
    layouts = [layout(folder / name) for name, layout in (("tum", _tum), ("rgbd", _rgbd))]
    files = {root: sorted(path for path in root.rglob("*") if path.is_file()) for root in layouts}
    originals = {path: path.read_bytes() for paths in files.values() for path in paths}

    def check(random: Random) -> None:
        root = random.choice(layouts)
        touched = random.sample(files[root], random.choice((1, 1, 2)))
        for path in touched:
            original = originals[path]
            is_text = path.suffix in {".txt"}
            if random.random() < 0.02:
                odd_file(random, path)
            else:
                path.write_bytes(_text(random, [original.decode()]) if is_text else mutated_bytes(random, original))
        try:
            with own_errors():
                dataset = open_dataset(root)
                for _ in itertools.islice(dataset.frames(with_depth=dataset.has_depth), MOST_FRAMES):
                    pass
        finally:
            for path in touched:
                removed(path)
                path.write_bytes(originals[path])

    return check


# -------------------------------------------------------------------------------------------------------------- images


def _images(folder: Path) -> Check:
    """What a decoder would take long for, or much memory, beside what is damaged."""
    rows, columns = np.mgrid[0:240, 0:320]
    pixels = np.stack([rows, columns % 256, (rows * columns) % 256], axis=2).astype(np.uint8)
    suffixes = (".jpg", ".png", ".bmp", ".ppm", ".tif")
    written = [(suffix, cv2.imencode(suffix, pixels)[1].tobytes()) for suffix in suffixes]
    progressive = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    sized = progressive.index(b"\xff\xc2") + 5

    def check(random: Random) -> None:
        suffix, data = random.choice((*written, (".jpg", progressive), (".jpg", progressive)))
        if data is progressive:
            if random.random() < 0.5:
                side = random.choice((64, 1000, 4096, 8000, 8192, 20_000, 65_535)).to_bytes(2)
                data = data[:sized] + side + side + data[sized + 4 :]
            if random.random() < 0.7:
                data = _with_scans(random, data)
        if random.random() < 0.6:
            data = mutated_bytes(random, data)
        path = folder / f"image{suffix}"
        _put(random, path, lambda: data)
        with own_errors():
            assert read_image(path, upright=random.random() < 0.5).shape[2] == 3
        removed(path)

    return check


def _with_scans(random: Random, data: bytes) -> bytes:
    """With one of its scans, and its tables, some times more."""
    scans = [at for at in range(len(data)) if data.startswith(b"\xff\xda", at)]
    which = random.randrange(len(scans))
    begin = max(data.rfind(b"\xff\xc4", 0, scans[which]), 0)
    end = scans[which + 1] if which + 1 < len(scans) else len(data) - 2
    return data[:end] + data[begin:end] * random.choice((1, 10, 90, 500, 5_000)) + data[end:]


# ----------------------------------------------------------------------------------------------------------- campaigns


def _campaigns(folder: Path) -> Check:
    file = folder / "campaign.yaml"
    scenario = ROOT / "config" / "paper_flight.yaml"
    vary = "vary: {drone.flocking.cohesion: {values: [0.1, 0.2]}}\nmeasure: [order_tail]\n"
    file.write_text(f"campaign: fuzz\nscenario: {scenario}\nseeds: 2\nscatter_m: 0.5\n{vary}", encoding="utf-8")
    plan, path = Plan.load(file), folder / "out"
    flown = [FlownRun(Run(cell, number), {"order_tail": 0.9}) for cell in range(2) for number in range(2)]
    with CampaignFolder(path, plan) as campaign:
        for one in flown[:3]:
            campaign.add([one])
        campaign.merge()
    originals = {one.relative_to(path): one.read_bytes() for one in path.rglob("*") if one.is_file()}
    values = json.loads(originals[Path(PLAN_NAME)])

    def check(random: Random) -> None:
        shutil.rmtree(path)
        (path / "parts").mkdir(parents=True)
        for original, data in originals.items():
            (path / original).write_bytes(data)
        write_table(FlightTable(plan).rows(flown[3:]), path / "parts" / "c1-s1.parquet")
        name = random.choice((PLAN_NAME, PLAN_NAME, FLIGHTS_NAME, TIMINGS_NAME, "parts/c1-s1.parquet", ".lock"))
        if name == PLAN_NAME and random.random() < 0.7:
            changed = json.dumps(mutated_json(random, values)).encode("utf-8", "surrogatepass")
            _put(random, path / name, lambda: changed)
        elif name.endswith("parquet") and random.random() < 0.4:
            source = random.choice((FLIGHTS_NAME, TIMINGS_NAME))
            (path / name).write_bytes(originals[Path(source)])
        else:
            content = (path / name).read_bytes() or b"?"
            _put(random, path / name, lambda: mutated_bytes(random, content))
        with own_errors():
            results = Results.load(path)
            for cell in results.plan.cells[:20]:
                results.interval("order_tail", [cell.number])
        with own_errors(), CampaignFolder(path, plan) as campaign:
            list(campaign.finished(None))

    return check


def _image(path: Path, *, depth: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = np.mgrid[0:12, 0:16]
    pixels = (rows * 20 + columns) * (100 if depth else 1)
    cv2.imwrite(str(path), pixels.astype(np.uint16 if depth else np.uint8))


def _tum(root: Path) -> Path:
    for index in range(3):
        _image(root / f"rgb/{index}.png")
        _image(root / f"depth/{index}.png", depth=True)
    for kind in ("rgb", "depth"):
        (root / f"{kind}.txt").write_text("# time file\n" + "".join(f"{i}.5 {kind}/{i}.png\n" for i in range(3)))
    (root / "K.txt").write_text("10 0 8\n0 10 6\n0 0 1\n")
    (root / "groundtruth.txt").write_text("".join(f"{i / 20} {i} 0 1 0 0 0 1\n" for i in range(80)))
    return root


def _rgbd(root: Path) -> Path:
    for index in range(2):
        _image(root / f"images/{index}.png")
        _image(root / f"depth/{index}.png", depth=True)
    (root / "K.txt").write_text("10 0 8\n0 10 6\n0 0 1\n")
    (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2)
    return root


TARGETS = (
    Target("configurations", 4, _configurations),
    Target("manifests", 10, _manifests),
    Target("recordings", 10, _recordings),
    Target("datasets", 40, _datasets),
    Target("images", 100, _images),
    Target("campaigns", 6, _campaigns),
)
