"""Writes what the documentation has from the code: the reference pages, and the picture of the rooms.

python -m tools.docs.docs_reference    # writes docs/reference/*.md and docs/pictures/rooms.svg
"""

from __future__ import annotations

import argparse
import ast
import inspect
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from flockd.campaign.campaign_file import CampaignConfig
from flockd.cli import EXIT_CODES, _parser
from flockd.core.config import DroneConfig
from flockd.core.config.safety import SafetyParameters
from flockd.core.consistency import CHECKS
from flockd.core.services import SERVICES
from flockd.flight.safety.policy import Barrier, rules
from flockd.onboard.autopilot.refusal_reasons import REASONS
from flockd.onboard.telemetry import topics
from flockd.sim.scenario import scenario_schema
from tests.faults.stories import faults, stories
from tools.docs import rooms

FOLDER = Path(__file__).parents[2] / "docs" / "reference"
NOTICE = "<!-- Written by tools/docs/docs_reference.py; do not edit. -->"


def main() -> None:
    """Writes the pages and the picture."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    rooms.PICTURE.write_text(rooms.picture(), encoding="utf-8")


def pages() -> dict[str, str]:
    """File name to text."""
    return {
        "configuration.md": configuration_page(),
        "commands.md": commands_page(),
        "messages.md": messages_page(),
        "faults.md": faults_page(),
        "refusals.md": refusals_page(),
        "files.md": files_page(),
    }


def refusals_page() -> str:
    """Every reason to refuse arming or offboard, with what to do: a row for each remedy."""
    rows: dict[str, tuple[list[str], list[str]]] = {}
    for name, reason in REASONS.items():
        whats, names = rows.setdefault(reason.remedy, ([], []))
        whats.append(reason.what)
        names.append(f"`{name}`")
    texts = {r: "; ".join(dict.fromkeys(w)).replace("` fails; its check `", "`, `") for r, (w, _) in rows.items()}
    return _page(
        "Why the autopilot refuses",
        "Every reason that flockd knows for which an autopilot refuses to arm or to fly offboard, and what to do, in",
        "the words of `flockd status`, `flockd doctor` and the log.",
        "[Why not offboard](../real_drone.md#why-not-offboard) shows how they are found.",
        "Names that begin with `check_` or `commander_` are those of PX4's events; the others are flockd's.",
        "",
        *_table(
            "what is the matter | what to do | name",
            ((texts[remedy], remedy, ", ".join(names)) for remedy, (_, names) in rows.items()),
        ),
    )


def configuration_page() -> str:
    """Every key of drone, scenario and campaign files; a section that several keys hold is listed once."""
    written: dict[str, str] = {}
    return _page(
        "Configuration reference",
        "Every key of the three kinds of file: its default, its type and limits, and what it means. Units are part of",
        "the names: `_m` metres, `_s` seconds, `_deg` degrees, `_px` pixels, `_hz` per second. Ranges and positions",
        "of a drone's file are in the body frame, those of a scenario in the world frame:",
        "see [Frames](../concepts/pipeline.md#coordinate-frames).",
        "A key whose default is `required` has to be written. `none`: it may be left out or be `null`. `its own`: the",
        "section may be left out, and each of its keys then has its default. `rig.cameras[].name` is the key `name` of",
        "each entry of the list `rig.cameras`.",
        "",
        "The [shipped files](files.md) are good to start from. `flockd config check FILE` reports everything that is",
        "wrong in a file, and `flockd config schema drone` prints the JSON schema that this page was made from.",
        "",
        *_kind_of_file("Drone files", DroneConfig.model_json_schema(), written),
        *_kind_of_file("Scenario files", scenario_schema(), written),
        *_kind_of_file("Campaign files", CampaignConfig.model_json_schema(), written),
    )


def _kind_of_file(heading: str, schema: Mapping[str, Any], written: dict[str, str]) -> list[str]:
    """The table of a file's own keys, then one for each of its sections that was not written before."""
    rows, below = [], []
    written[schema["title"]] = f"[{heading.lower()}](#{_slug(heading)})"
    for key, value in schema["properties"].items():
        inner, many = _inner(schema, value)
        default, shown = _default(key, value, schema.get("required", ())), f"{key}{many}"
        own, *held = _row(schema, key, value, "", default, written)
        if len(held) < ENOUGH_FOR_A_TABLE:
            rows += [own, *held]
            continue
        text = _one_line(value.get("description") or (inner or {}).get("description", ""))
        below += [f"### `{shown}`", DEFAULTS.get(default, "None by default. ") + text, ""]
        below += _table("key | default | meaning", _together(held))
    text = _one_line(schema.get("description", ""))
    return [f"## {heading}", text, "", *_table("key | default | meaning", _together(rows)), *below]


DEFAULTS = {"required": "Required. ", "its own": ""}
KINDS = {"": "section", "[]": "list of sections", ".KEY": "section for each key"}


ENOUGH_FOR_A_TABLE = 6
"""Keys of a section; one with fewer stands in the table of its file."""


def _keys(
    root: Mapping[str, Any], schema: Mapping[str, Any], path: str, written: dict[str, str]
) -> Iterator[tuple[str, str, str]]:
    """The keys of the section at a path, those of a section in it right below that one's own row."""
    for key, value in schema["properties"].items():
        yield from _row(root, key, value, f"{path}.", _default(key, value, schema.get("required", ())), written)


def _row(
    root: Mapping[str, Any], key: str, value: Mapping[str, Any], path: str, default: str, written: dict[str, str]
) -> Iterator[tuple[str, str, str]]:
    """The row of a key, and those of the keys that it holds unless they were written before."""
    inner, many = _inner(root, value)
    here = f"{path}{key}"
    if inner is None:
        yield f"`{here}`", default, _meaning(value)
    elif inner["title"] in written:
        yield f"`{here}`", default, _section(inner, many, value, written)
    else:
        yield f"{_anchor(here + many)}`{here}`", default, _section(inner, many, value, written)
        written[inner["title"]] = f"[`{here}{many}`](#{_slug(here + many)})"
        yield from _keys(root, inner, here + many, written)


def _together(rows: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    """The rows, with neighbouring keys of the same default and type, and without a description, in one row."""
    for (default, kind), keys in itertools.groupby(rows, lambda row: row[1:]):
        names = [name for name, _, _ in keys]
        if "." in kind:
            yield from ((name, default, kind) for name in names)
        else:
            yield ", ".join(names), default, kind


def _section(inner: Mapping[str, Any], many: str, value: Mapping[str, Any], written: Mapping[str, str]) -> str:
    where = f" as {written[inner['title']]}" if inner["title"] in written else ""
    return f"{KINDS[many]}{where}. {_one_line(value.get('description') or inner.get('description', ''))}".strip()


def _inner(root: Mapping[str, Any], value: Mapping[str, Any]) -> tuple[Mapping[str, Any] | None, str]:
    """The section that a key holds, or a list of (`[]`), or one for each key (`.KEY`); None: a plain value."""
    for choice in (value, *value.get("allOf", ()), *value.get("anyOf", ())):
        others = choice.get("additionalProperties")
        for many, one in (("", choice), ("[]", choice.get("items")), (".KEY", others)):
            if isinstance(one, Mapping) and "$ref" in one:
                found = root["$defs"][one["$ref"].rpartition("/")[2]]
                if "properties" in found:
                    return found, many
    return None, ""


def _default(key: str, value: Mapping[str, Any], required: Sequence[str]) -> str:
    if key in required:
        return "required"
    default = value.get("default")
    if default is None:
        return "none"
    if isinstance(default, Mapping):
        return "its own"
    return f"`{_yaml(default)}`"


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_yaml(part) for part in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _meaning(value: Mapping[str, Any]) -> str:
    text = _one_line(value.get("description", ""))
    kind = _kind(value)
    return f"{kind}. {text}" if text else kind


def _kind(value: Mapping[str, Any]) -> str:
    """Type and limits in words."""
    if "anyOf" in value:
        return " or ".join(_kind(choice) for choice in value["anyOf"] if choice.get("type") != "null")
    if "enum" in value:
        return ", ".join(f"`{choice}`" for choice in value["enum"])
    if "const" in value:
        return f"`{value['const']}`"
    kind = {"number": "number", "integer": "whole number", "string": "text", "boolean": "`true` or `false`"}
    if value.get("type") == "array":
        parts = value.get("prefixItems")
        if parts:
            return f"list of {len(parts)} numbers" if all("type" in part for part in parts) else "list"
        return f"list of {_kind(value.get('items', {}))}"
    limits = []
    for name, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤")):
        if name in value:
            limits.append(f"{sign} {value[name]:g}")
    return " ".join([kind.get(value.get("type", ""), "value"), ", ".join(limits)]).strip()


def commands_page() -> str:
    """Every command with its options and examples; what several commands of a group take is listed once."""
    codes = EXIT_CODES.splitlines()[1:]
    (groups,) = (action for action in _parser()._actions if isinstance(action, argparse._SubParsersAction))
    return _page(
        "Command-line reference",
        "Every command prints this with `--help`, and more examples and costs. `--json` prints for programs what is",
        "otherwise printed for people.",
        "No command overwrites a file or an earlier flight, unless `--force` is given.",
        "",
        *_table("exit code | meaning", (map(str.strip, line.split(maxsplit=1)) for line in codes)),
        *(line for group in dict.fromkeys(groups.choices.values()) for line in _group(group)),
    )


SAID_ABOVE = re.compile("print (JSON|the [a-z]+ as JSON|what was flown as JSON)|overwrite .*")
"""Help of options that the page explains once."""
EXAMPLES = 2
"""Of each command."""


def _leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The commands that do something, in the order of the help: some that have commands do so without one too."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    idle = (argparse._HelpAction, argparse._VersionAction)
    if not inner or any(action.option_strings and not isinstance(action, idle) for action in parser._actions):
        yield parser
    for action in inner:
        for command in dict.fromkeys(action.choices.values()):
            yield from _leaves(command)


def _group(group: argparse.ArgumentParser) -> list[str]:
    """A command, or those that begin with the same word."""
    commands = {command.prog.rpartition(" ")[2]: command for command in _leaves(group)}
    takers: dict[tuple[str, str], list[str]] = {}
    examples, notes = [], []
    for name, command in commands.items():
        for action in filter(lambda action: not SAID_ABOVE.fullmatch(action.help or ""), _shown(command)):
            takers.setdefault((_named(action), _help(command, action)), []).append(f"`{name}`")
        shown, _, note = (command.epilog or "").partition("\n\n")
        new = [line.strip() for line in shown.splitlines()[1:] if line.strip() not in examples]
        examples += new[:EXAMPLES]
        if note and "\n  " not in note:
            notes += [*note.splitlines(), ""]
    usage = [f"`{_usage(command)}`: {command.description}" for command in commands.values()]
    if len(commands) == 1:
        options = _table("option | meaning", takers)
    else:
        usage = [f"- {line}" for line in usage]
        options = _table(
            "option | of | meaning",
            (
                (option, "all" if len(of) == len(commands) else ", ".join(of), text)
                for (option, text), of in takers.items()
            ),
        )
    return [f"## {group.prog}", *usage, "", *options, "```sh", *examples, "```", "", *notes]


def _shown(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    hidden = (argparse._HelpAction, argparse._SubParsersAction)
    return [a for a in parser._actions if a.help != argparse.SUPPRESS and not isinstance(a, hidden)]


def _usage(parser: argparse.ArgumentParser) -> str:
    shown = _shown(parser)
    words = [parser.prog, *(_positional(action) for action in shown if not action.option_strings)]
    words += [_option(action) for action in shown if action.option_strings and action.required]
    free = [action for action in shown if action.option_strings and not action.required]
    said = [f"[{_option(action)}]" for action in free if SAID_ABOVE.fullmatch(action.help or "")]
    return " ".join([*words, *(["[OPTIONS]"] if len(free) > len(said) else []), *said])


def _positional(action: argparse.Action) -> str:
    name = str(action.metavar or action.dest)
    if action.choices is not None and action.metavar is None:
        name = f"{{{','.join(map(str, action.choices))}}}"
    return {"?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} ..."}.get(str(action.nargs), name)


def _option(action: argparse.Action) -> str:
    name = action.option_strings[-1]
    if action.nargs == 0:
        return name
    if action.metavar is None and action.choices is not None:
        return f"{name} {{{','.join(map(str, action.choices))}}}"
    metavar = action.metavar or action.dest.upper()
    words = metavar if isinstance(metavar, tuple) else (metavar,)
    return f"{name} {' '.join(words)}"


def _named(action: argparse.Action) -> str:
    text = _option(action) if action.option_strings else _positional(action)
    return f"`{text}`"


def _help(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    text = _one_line(parser._get_formatter()._expand_help(action)) if action.help else ""
    if action.choices is not None and action.metavar is not None and not all(map(text.__contains__, action.choices)):
        text += f" ({', '.join(map(str, action.choices))})"
    return text


def messages_page() -> str:
    """Topics and the fields of their messages."""
    rows, fields = [], []
    for topic in topics.TOPICS.values():
        name = topic.type.__name__
        rate = "on events" if topic.rate_hz is None else f"{topic.rate_hz:g}"
        stale = "never" if topic.stale_after_s is None else f"{topic.stale_after_s:g}"
        rows.append((f"`{topic.key}`", f"[{name}](#{_slug(name)})", rate, stale, "yes" if topic.recorded else "no"))
    for node in ast.parse(inspect.getsource(topics)).body:
        if isinstance(node, ast.ClassDef) and any(isinstance(b, ast.Name) and b.id == "TypedDict" for b in node.bases):
            fields.append((f"{_anchor(node.name)}**{node.name}**", "", _one_line(ast.get_docstring(node) or "")))
            first = len(fields)
            for name, kind, text in _fields(node):
                type_ = f"`{kind.replace(' | None', ' or null')}`"
                alike = [i for i in range(first, len(fields)) if not text and fields[i][1:] == (type_, "")]
                if alike:
                    fields[alike[0]] = (f"{fields[alike[0]][0]}, `{name}`", type_, "")
                else:
                    fields.append((f"`{name}`", type_, text))
    return _page(
        "Telemetry messages",
        "A key is `flockd/v1/<fleet>/<drone>/<topic>`; a message is a JSON object in UTF-8. Every number is finite or",
        "`null`. Vectors are lists in [NED](../concepts/pipeline.md#coordinate-frames).",
        "Times are seconds on the drone's monotonic clock.",
        "How to connect: [Telemetry](../fleet_page.md#telemetry).",
        "",
        *_table("topic | message | expected rate, Hz | stale after, s | recorded", rows),
        "## Fields",
        *_table("message, its fields | type | meaning", fields),
    )


def _fields(node: ast.ClassDef) -> Iterator[tuple[str, str, str]]:
    """Name, type and the string below each field."""
    for here, following in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(here, ast.AnnAssign) and isinstance(here.target, ast.Name):
            text = ""
            if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                text = str(following.value.value)
            yield here.target.id, ast.unparse(here.annotation), _one_line(text)


def files_page() -> str:
    """Every shipped file of `config/`, with the first paragraph of the comment at its head."""
    folder, rows = FOLDER.parents[1] / "config", []
    for path in [*folder.glob("*.*"), *folder.glob("campaigns/*"), *folder.glob("templates/*")]:
        name = path.relative_to(folder.parent)
        head = "".join(re.findall(r"\A((?:(?:#|//) .+\n)+)", path.read_text(encoding="utf-8")))
        rows.append((f"{_anchor(str(name))}`{name}`", _one_line(re.sub("^(?:#|//) ", "", head, flags=re.MULTILINE))))
    rows.sort(key=lambda row: (row[0].count("/"), row))
    return _page(
        "Shipped configuration files",
        "They come with the repository and with the installed package. Copy one and change the copy. Every key that",
        "a file leaves out has the default of the [configuration reference](configuration.md);",
        "`flockd config show FILE` prints a file with every default filled in.",
        "",
        *_table("file | what it is for", rows),
    )


BEFORE = {Barrier.NONE: "may fly", Barrier.WAIT: "waits until it has passed", Barrier.LATCH: "waits for the ground"}


def faults_page() -> str:
    """Every event that the supervisor knows, and its rule."""
    known = rules(SafetyParameters())
    events = {event.value for event in known}

    def told(reaction: str) -> str:
        return f"`{reaction}`" if reaction in events else reaction

    def keys(names: Sequence[str]) -> str:
        return ", ".join(f"`{name}`" for name in names)

    rows = []
    for event, rule in known.items():
        later = "" if math.isinf(rule.after_s) else f"{rule.later.name.lower()} after {rule.after_s:g} s"
        rows.append((f"`{event.value}`", BEFORE[rule.barrier], rule.reaction.name.lower(), later))
    return _page(
        "Faults and reactions",
        "Every event that the supervisor notices, by its name in telemetry, with the defaults of",
        "[`safety`](configuration.md#safety). [Safety](../safety.md) explains the columns.",
        "",
        *_table("event | before the flight | in flight | if it lasts", rows),
        "## Time-outs",
        "How old each message may become, and what is done then. A reaction in code type is an event of the table",
        "above. The keys of the [configuration](configuration.md) change a time-out for one drone.",
        "",
        *_table(
            "message | rate, Hz | time-out | reaction | keys",
            (
                (s.message, f"{s.rate_hz:g}", f"{s.timeout:g} {s.unit}", told(s.reaction), keys(s.keys))
                for s in SERVICES
            ),
        ),
        "## Consistency of sensors",
        "What one source says is compared with what the others lead to expect, as an extended Kalman filter does with",
        "its innovations. SD: standard deviations of what is expected.",
        "",
        *_table(
            "compared | limit | beyond it | where the limit comes from | begins with this default",
            ((c.compared, f"{c.limit:g} {c.unit}", told(c.reaction), c.source, keys(c.keys)) for c in CHECKS),
        ),
        *_stories(),
    )


def _stories() -> list[str]:
    """The list of faults, and the tests that their markers name."""
    known, rows = stories(), []
    for name, fault in faults().items():
        told = [story for story in known if story.fault == name]
        limits = [story.within_s for story in told if story.within_s is not None]
        tests = ", ".join(f"`{story.test.removeprefix('tests/')}`" for story in told)
        within, runs = f"{max(limits):g}" if limits else "", ", ".join(sorted({story.runs for story in told}))
        rows.append((str(fault.row), f"`{name}`", fault.fault, fault.reaction, within, runs, tests))
    return [
        "## Stories",
        "The faults that flockd has to survive, by the name that `pytest -m fault --fault NAME` takes, and the tests",
        "that inject each. s: the longest reaction that they allow. Run: by CI (`.ci/run`), by hand (`make flights`),",
        "or with PX4.",
        "",
        *_table("| fault | what happens | what flockd does | s | run | shown by", rows),
    ]


def _page(title: str, *lines: str) -> str:
    return "\n".join([f"# {title}", "", NOTICE, "", *lines]).rstrip() + "\n"


def _table(columns: str, rows: Iterable[Iterable[str]]) -> list[str]:
    """With an empty line after it; ``columns``: their heads, with | between them."""
    count = columns.count("|") + 1
    return [f"| {columns} |", "|---" * count + "|", *(f"| {' | '.join(row)} |" for row in rows), ""]


def _one_line(text: str) -> str:
    """As one line that can stand in a table."""
    return re.sub(r"\s+", " ", text.replace("``", "`")).strip().replace("|", "\\|").replace("<", "&lt;")


def _anchor(heading: str) -> str:
    """A place in a table to link to, as one would link to a heading."""
    return f'<a id="{_slug(heading)}"></a>'


def _slug(heading: str) -> str:
    """The anchor that Python-Markdown gives a heading."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower())


if __name__ == "__main__":
    main()
