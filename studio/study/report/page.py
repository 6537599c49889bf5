"""report.html: the whole study on one page that needs nothing from elsewhere, neither script nor picture."""

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from studio.security import style_digest
from studio.study.plan import PlannedTask, Study, Variant
from studio.study.report.claims import CLAIMS, Verdict
from studio.study.report.drawing import Drawing
from studio.study.report.results import DesignRow, Results, RunRow, chosen
from studio.study.report.summary import COLUMNS, NOTHING, summary

SIGNS: dict[Verdict, str] = {"held": "✓", "not held": "✗", "not testable": "·"}


@dataclass(frozen=True)
class _Line:
    """A run as a line of the table of every seed."""

    variant: str
    seed: int
    status: str
    reason: str
    kind: str
    cells: list[str]
    phi: str


@dataclass(frozen=True)
class _Task:
    """What the page says of one task."""

    name: str
    options: str
    units: str
    summary: list[list[str]]
    rows: list[_Line]
    labels: list[str]
    settings: list[tuple[str, list[str]]]


def page(results: Results, drawings: Sequence[tuple[Drawing, str]], directory: Path) -> str:
    """Return the page; `drawings` are figures with their SVG. What came from a run is escaped."""
    shipped = files("studio.study.report") / "shipped"
    style = (shipped / "report.css").read_text(encoding="utf-8").strip()
    environment = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined)
    template = environment.from_string((shipped / "report.html").read_text(encoding="utf-8"))
    claims = [(claim, claim.findings(results)) for claim in CLAIMS]
    verdicts = [finding.verdict for _, findings in claims for finding in findings]
    study = results.study
    return template.render(
        title=f"Study: {len(study.variants)} {_plural('method', study.variants)} on {' and '.join(results.tasks)}",
        style=style,
        style_digest=style_digest(style),
        study=study,
        seeds=ranges(study.seeds),
        ended=sum(row.has_ended for row in results.runs),
        waiting=_waiting(results.runs),
        failed=[row.run for row in results.runs if row.status == "failed"],
        written=time.strftime("written %Y-%m-%d %H:%M UTC", time.gmtime()),
        columns=COLUMNS,
        tasks=[_task(results, task) for task in study.tasks],
        claims=claims,
        tally=[(verdict, verdicts.count(verdict)) for verdict in SIGNS],
        signs=SIGNS,
        drawings=drawings,
        reasons=[(r.run, r.reason) for r in results.runs if r.reason and r.status in ("failed", "lost", "unreadable")],
        command=f"morph-studio study --report {shlex.quote(directory.resolve().name)}",
        again=command_of(study),
        versions=sorted(study.versions.items()),
    )


def _waiting(rows: Sequence[RunRow]) -> str:
    """Return how many runs have not ended, by their status."""
    open_ = [row.status for row in rows if not row.has_ended]
    return ", ".join(f"{open_.count(status)} {status}" for status in dict.fromkeys(open_))


def _task(results: Results, task: PlannedTask) -> _Task:
    rows = [row for row in results.runs if row.task == task.name]
    designs: dict[str, list[DesignRow]] = {}
    for row in results.designs:
        designs.setdefault(row.run, []).append(row)
    places = {label: i for i, label in enumerate(results.variants)}
    rows.sort(key=lambda row: (places[row.variant], row.seed))
    units = dict.fromkeys(row.unit for row in results.designs if row.task == task.name)
    labels = [label for label in results.variants if chosen(results.settings, task.name, label)]
    return _Task(
        task.name,
        ", ".join(f"{name}={value}" for name, value in task.options.items()),
        ", ".join(units),
        summary(results, task.name),
        [_line(row, designs.get(row.run, [])) for row in rows],
        labels,
        _settings(results, task.name, labels),
    )


def _line(row: RunRow, design: list[DesignRow]) -> _Line:
    of = f"/{row.end_episodes}" if row.end_episodes else ""
    sampled, deterministic = row.sampled_successes, row.deterministic_successes
    cells = [
        f"{number(row.sampled_success, 3)}{f' ({sampled}{of})' if sampled is not None else ''}",
        f"{number(row.deterministic_success, 3)}{f' ({deterministic}{of})' if deterministic is not None else ''}",
        number(row.sampled_return, 2),
        number(row.sampled_solved_steps, 2, 1e-6),
        number(row.sampled_solved_cpu_seconds, 0),
        number(row.env_steps, 2, 1e-6),
        number(row.cpu_seconds, 0),
        f"{number(row.negative_share, 0, 100)} %" if row.negative_share is not None else NOTHING,
        f"{row.divergence_first:.3g} → {row.divergence_last:.3g}"
        if row.divergence_first is not None and row.divergence_last is not None
        else NOTHING,
    ]
    phi = "  ".join(f"{one.final:.2f}" for one in design)
    kind = "failed" if row.status in ("failed", "unreadable") else "" if row.has_ended else "waiting"
    return _Line(row.variant, row.seed, row.status, row.reason, kind, cells, phi)


def _settings(results: Results, task: str, labels: list[str]) -> list[tuple[str, list[str]]]:
    """Return every setting with its value in each variant that has it."""
    configs = [results.config(task, label) for label in labels]
    return [
        (name, [config.get(name, "") for config in configs])
        for name in dict.fromkeys(name for config in configs for name in config)
    ]


def number(value: float | None, digits: int, factor: float = 1.0) -> str:
    """Return a number with so many digits behind the point, or a dash for None."""
    return NOTHING if value is None else f"{factor * value:.{digits}f}"


def ranges(seeds: Sequence[int]) -> str:
    """Return seeds as the command line takes them: 0-9,20."""
    parts: list[list[int]] = []
    for seed in sorted(seeds):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ",".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)


def command_of(study: Study) -> str:
    """Return the command that runs a study of this plan."""
    tasks = [_word(task.name, task.options) for task in study.tasks]
    words = ["morph-studio", "study", *tasks, "--methods", *map(_variant, study.variants)]
    words += ["--seeds", ranges(study.seeds), "--env-steps", str(study.env_steps), "--level", f"{study.level:g}"]
    words += ["--final-episodes", str(study.final_episodes), "--out", "DIR"]
    return " ".join(map(shlex.quote, words))


def _variant(variant: Variant) -> str:
    word = _word(variant.preset or variant.method, variant.settings)
    return word if word == variant.label else f"{variant.label}:{word}"


def _word(name: str, settings: dict[str, object]) -> str:
    return ",".join([name, *(f"{key}={_value(value)}" for key, value in settings.items())])


def _value(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _plural(noun: str, things: Sequence[object]) -> str:
    return noun if len(things) == 1 else f"{noun}s"
