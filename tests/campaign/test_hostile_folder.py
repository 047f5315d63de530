"""A campaign's folder that was changed anywhere."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from random import Random

from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import LINES_NAME, PLAN_NAME, CampaignFolder, flown_in
from flockd.campaign.results import Results
from tests.hostile import ROOT, hostile, mutated_bytes, mutated_json, own_errors, put


def test_a_changed_campaign_is_read_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "campaign.yaml"
    scenario = ROOT / "config" / "paper_flight.yaml"
    vary = "vary: {drone.flocking.cohesion: {values: [0.1, 0.2]}}\nmeasure: [order_tail]\n"
    file.write_text(f"campaign: fuzz\nscenario: {scenario}\nseeds: 2\nscatter_m: 0.5\n{vary}", encoding="utf-8")
    plan, path = Plan.load(file), tmp_path / "out"
    flown = [FlownRun(Run(cell, number), {"order_tail": 0.9}) for cell in range(2) for number in range(2)]
    with CampaignFolder(path, plan) as campaign:
        campaign.add(flown)
        campaign.write_table()
    originals = {one.relative_to(path): one.read_bytes() for one in path.rglob("*") if one.is_file()}
    values = json.loads(originals[Path(PLAN_NAME)])

    @hostile(5)
    def check(random: Random) -> None:
        shutil.rmtree(path)
        path.mkdir(parents=True)
        for original, data in originals.items():
            (path / original).write_bytes(data)
        name = random.choice((PLAN_NAME, PLAN_NAME, LINES_NAME, LINES_NAME, ".lock"))
        if name == PLAN_NAME and random.random() < 0.7:
            changed = json.dumps(mutated_json(random, values)).encode("utf-8", "surrogatepass")
            put(random, path / name, lambda: changed)
        else:
            content = (path / name).read_bytes() or b"?"
            put(random, path / name, lambda: mutated_bytes(random, content))
        with own_errors():
            results = Results.load(path)
            for cell in results.plan.cells[:20]:
                results.interval("order_tail", [cell.number])
        with own_errors(), CampaignFolder(path, plan) as campaign:
            flown_in(path, plan)
            campaign.write_table()

    check()
