"""`flockd campaign`: many flights of a scenario, their results and their report."""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from flockd.cli.options import refuse, refuse_overwriting
from flockd.cli.output import Phases, complain, say_result
from flockd.cli.parser import Commands, commands_of, existing, flag, option, positive_count
from flockd.core.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from flockd.campaign.flight_plan import Plan
    from flockd.campaign.results import Results, Verdict

RUN = "run"
COSTS = """\
costs: `--dry-run` estimates them. A flight of five drones for 110 s takes a second of processor time on exact states;
by sight each simulated second takes up to 12 s. A flight's row takes 1 kB.
However a campaign ends, it loses only unfinished flights: the same command flies the missing ones."""


def add(commands: Commands) -> None:
    """Adds the command."""
    examples: tuple[str, ...] = (
        "flockd campaign config/campaigns/separation.yaml --dry-run",
        "flockd campaign config/campaigns/separation.yaml",
        "flockd campaign report out/separation",
        "flockd campaign rerun out/separation/c3-s12",
    )
    description = (
        "Fly many flights of a scenario, rerun one of them, report on all; `campaign FILE` is `campaign run FILE`."
    )
    parser = commands("campaign", description, examples)
    parser.default_command, commands = RUN, commands_of(parser)
    examples = (
        "flockd campaign config/campaigns/separation.yaml --dry-run",
        "flockd campaign config/campaigns/separation.yaml --workers 4 --out out/tonight",
    )
    parser = commands(RUN, "Fly the missing flights of a campaign, and write its report.", examples, _run, notes=COSTS)
    option(parser, "FILE", "the campaign's file", existing)
    option(parser, "--out FOLDER", "folder of the results (default: out/NAME, by the campaign's name)", Path)
    option(parser, "--workers N", "flights at once (default: one a processor)", positive_count)
    flag(parser, "--dry-run", "print the number of flights and hours; fly and write nothing")
    flag(parser, "--json", "print what was flown as JSON")
    examples = (
        "flockd campaign rerun out/separation/c3-s12",
        "flockd campaign rerun out/night/c0-s7 --out out/why --json",
    )
    parser = commands("rerun", "Fly one flight of a campaign again, with its full report.", examples, _rerun)
    parser.add_argument("flight", metavar="RUN", type=Path, help="the campaign's folder, and the flight's name in it")
    option(parser, "--out DIR", "folder of the report (default: FOLDER/reruns/NAME)", Path)
    flag(parser, "--force", "overwrite an earlier flight in that folder")
    flag(parser, "--json", "print the summary as JSON")
    parser.set_defaults(quiet=False)
    examples = ("flockd campaign report out/separation", "flockd campaign report out/old_networks out/new_networks")
    parser = commands("report", "Write the report of a campaign, or compare a second one with it.", examples, _report)
    option(parser, "FOLDER", "a campaign's folder", existing)
    option(parser, "OTHER", "a second campaign's folder: are its figures better than FOLDER's?", existing, nargs="?")
    option(parser, "--out FILE", "file of the report (default: report.html in FOLDER)", Path)
    flag(parser, "--json", "print the figures as JSON")


def _run(args: argparse.Namespace) -> int:
    from flockd.campaign.campaign_page import write_campaign_page
    from flockd.campaign.conduct import conduct
    from flockd.campaign.engine import ProcessEngine
    from flockd.campaign.flight_plan import Plan
    from flockd.campaign.folder import REPORT_NAME, CampaignFolder
    from flockd.campaign.results import Results

    workers = args.workers or os.cpu_count() or 1
    plan = Plan.load(args.file)
    if args.dry_run:
        return _dry_run(args, plan, workers)
    path = args.out or Path("out") / plan.config.campaign
    try:
        with (
            CampaignFolder(path, plan) as folder,
            ProcessEngine(workers) as engine,
            Phases() as phases,
        ):
            conducted = conduct(plan, folder, engine, phases.of("flying", "flights"))
    except KeyboardInterrupt:
        complain(f"interrupted; every finished flight is in {path}, and the same command goes on with the others")
        return ExitCode.INTERRUPTED
    write_campaign_page(Results.load(path), path / REPORT_NAME)
    before = f", {conducted.before} were there already" if conducted.before else ""
    told = f"{conducted.flown} flights flown, {conducted.failed} of them failed{before}"
    say_result(args, {"folder": str(path), **asdict(conducted)}, told, f"report: {path / REPORT_NAME}")
    return ExitCode.CHECK_FAILED if conducted.failed else ExitCode.DONE


def _dry_run(args: argparse.Namespace, plan: Plan, workers: int) -> int:
    from flockd.campaign.conduct import estimate

    with Phases() as phases:
        flight_s = estimate(plan, phases.of("trial flights", "cells"))
    cells, flights, hours = len(plan.cells), plan.flights, plan.flights * flight_s / 3600 / workers
    return say_result(
        args,
        {"cells": cells, "flights": flights, "flight_s": flight_s, "hours": hours},
        f"{cells} cells, {flights} flights of {flight_s:.2g} s on one core",
        f"{hours:.2g} h with {workers} at once, if each has a core of its own",
    )


def _rerun(args: argparse.Namespace) -> int:
    from flockd.campaign.flight_kinds import PERCEPTIONS
    from flockd.campaign.flight_plan import Run
    from flockd.campaign.folder import RERUNS, load_plan
    from flockd.cli.output import report_flight
    from flockd.review.report.flight_folder import prepare_folder
    from flockd.sim.flock.swarm import fly

    folder, name = args.flight.parent, args.flight.name
    numbers = re.fullmatch(r"c(\d{1,9})-s(\d{1,9})", name)
    if numbers is None:
        raise UsageError(f"{name!r} is not the name of a flight; write one as in {folder}/c0-s0")
    plan, run = load_plan(folder), Run(int(numbers[1]), int(numbers[2]))
    if run.cell >= len(plan.cells) or run.number >= plan.config.seeds:
        last = Run(len(plan.cells) - 1, plan.config.seeds - 1)
        raise UsageError(f"{folder}: has no flight {name}; the last one is {last.name}")
    scenario = plan.task(plan.cells[run.cell], run.number).scenario()
    directory = args.out or folder / RERUNS / name
    prepare_folder(directory, force=args.force)
    with Phases() as phases:
        flight = fly(
            scenario,
            perception=PERCEPTIONS[plan.config.perception],
            gated=plan.config.gated,
            progress=phases.of("flying", "steps"),
        )
    return report_flight(directory, flight, args)


def _report(args: argparse.Namespace) -> int:
    refuse_overwriting(args, args.out)
    from flockd.campaign.campaign_page import write_campaign_page
    from flockd.campaign.folder import REPORT_NAME
    from flockd.campaign.results import Results, compare

    results = Results.load(args.folder)
    if args.other is None:
        path = args.out or args.folder / REPORT_NAME
        write_campaign_page(results, path)
        return say_result(args, _cell_figures(results), f"report: {path}")
    refuse(args, ("out",), "is for the report of one campaign; drop it")
    comparison = compare(results, Results.load(args.other))
    verdicts = comparison.verdicts
    facts = [{**asdict(one), "difference": one.difference._asdict(), "says": one.says} for one in verdicts]
    lines = [f"  {_verdict_line(one)}" for one in verdicts]
    changes = [f"  for all flights {key} was {was} and is {now}" for key, was, now in comparison.changes]
    return say_result(args, facts, f"{comparison.sentence}.", *lines, *changes)


def _verdict_line(verdict: Verdict) -> str:
    from flockd.campaign.campaign_page import label_of

    low, high = verdict.difference.low, verdict.difference.high
    means = f"{verdict.first:.4g} and {verdict.second:.4g}"
    return (
        f"{label_of(verdict.figure)}: {verdict.says}, {means}, difference {low:+.3g} to {high:+.3g}, p {verdict.p:.2g}"
    )


def _cell_figures(results: Results) -> list[dict[str, object]]:
    cells = []
    for cell in results.plan.cells:
        intervals = {figure: results.interval(figure, [cell.number]) for figure in results.figures}
        figures = {figure: found and found._asdict() for figure, found in intervals.items()}
        cells.append({"cell": cell.number, "parameters": dict(cell.parameters), "figures": figures})
    return cells
