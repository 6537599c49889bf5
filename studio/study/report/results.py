"""What the runs of a study came to, as rows of plain numbers: one per run, per iteration, and per design parameter."""

import contextlib
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from morph_core.config import flattened
from morph_core.history import History
from morph_core.protocol import Evaluation, Progress, RunRecord, Status
from morph_core.run_folder import RunFolder, RunFolderError
from studio.study.plan import PlannedRun, Study, read_study

ENDS = 5
"""Iterations whose mean is the first and the last value of a curve."""

Row = TypeVar("Row", "RunRow", "CurveRow", "DesignRow", "SettingRow")


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """One run. What it did not measure is None."""

    task: str
    variant: str
    seed: int
    run: str
    method: str
    exploration: str | None = None
    search: str | None = None
    projection: str | None = None
    alpha: float | None = None
    status: str
    """Status of the run; "not started" where it has no folder yet."""
    reason: str = ""
    iterations: int = 0
    env_steps: int = 0
    """Steps of trajectories, on Hw-Phy and in the proxy's world alike."""
    relabelled_steps: int = 0
    """Steps of Hw-Phy for the proxy's fit and for relabelling."""
    search_steps: int = 0
    """Steps of Hw-Phy that the search for phi took."""
    cpu_seconds: float = 0.0
    sampled_solved_steps: int | None = None
    """env_steps at the first evaluation in which the sampled policy's success was at least the study's level."""
    sampled_solved_cpu_seconds: float | None = None
    deterministic_solved_steps: int | None = None
    deterministic_solved_cpu_seconds: float | None = None
    end_episodes: int | None = None
    """Episodes of each kind in the last evaluation; None where they were not written down."""
    end_is_final: bool = False
    """Whether the last evaluation is the one at the end of the budget."""
    sampled_success: float | None = None
    """Share of the last evaluation's sampled episodes that reached the goal."""
    sampled_successes: int | None = None
    sampled_return: float | None = None
    deterministic_success: float | None = None
    deterministic_successes: int | None = None
    deterministic_return: float | None = None
    milestones: str = ""
    """Shares of the sampled episodes that reached what comes before the goal: "lifted 0.93, pressed 0.12"."""
    diverged: int = 0
    negative_share: float | None = None
    """Mean share of gradient steps with a negative cosine, over the iterations in which phi moved."""
    cosine: float | None = None
    """Mean cosine of g_task and g_hw over the same iterations."""
    divergence_first: float | None = None
    """Loss of the proxy, mean of the first five of these iterations."""
    divergence_last: float | None = None
    search_cost_first: float | None = None
    search_cost_last: float | None = None
    loss_and_cost_rank: float | None = None
    """Spearman's rank correlation of the proxy's loss and the search cost over the same iterations."""

    @property
    def has_ended(self) -> bool:
        """Whether the run counts in a comparison: it went through its budget, or it died on the way."""
        return self.status in ("finished", "failed")

    def ends_at(self, level: float) -> bool:
        """Tell whether the run ended with at least this success; one that failed did not."""
        return self.status == "finished" and self.sampled_success is not None and self.sampled_success >= level

    @property
    def score(self) -> float:
        """Success of the sampled policy at the end; 0 for a run that failed."""
        return self.sampled_success or 0.0 if self.status == "finished" else 0.0

    def milestone(self, name: str) -> float | None:
        """Return the share of the last sampled episodes that reached a milestone; None if it was not measured."""
        shares = dict(part.rsplit(" ", 1) for part in self.milestones.split(", ") if part)
        return float(shares[name]) if name in shares else None


@dataclass(frozen=True, kw_only=True)
class CurveRow:
    """One iteration of a run, and the evaluation after it, if there was one."""

    task: str
    variant: str
    seed: int
    run: str
    iteration: int
    env_steps: int
    relabelled_steps: int
    search_steps: int
    cpu_seconds: float
    episode_return: float | None
    """Mean return of the iteration's trajectories, over the designs that were explored."""
    success: float | None
    phi_moved: bool
    divergence: float | None
    search_cost: float | None
    cosine: float | None
    cosine_negative: float | None
    sampled_success: float | None = None
    sampled_return: float | None = None
    deterministic_success: float | None = None
    deterministic_return: float | None = None


@dataclass(frozen=True, kw_only=True)
class DesignRow:
    """One design parameter of a run; all numbers in `unit`."""

    task: str
    variant: str
    seed: int
    run: str
    parameter: str
    unit: str
    lo: float
    hi: float
    initial: float
    final: float
    best: float
    """Value in the design of the best evaluation."""


@dataclass(frozen=True, kw_only=True)
class SettingRow:
    """One setting of a variant on a task, as its runs have it."""

    task: str
    variant: str
    setting: str
    """Dotted name."""
    value: str


@dataclass(frozen=True)
class Results:
    """All rows of a study, and what they are rows of."""

    study: Study
    runs: list[RunRow] = field(default_factory=list)
    curves: list[CurveRow] = field(default_factory=list)
    designs: list[DesignRow] = field(default_factory=list)
    settings: list[SettingRow] = field(default_factory=list)
    records: dict[str, RunRecord] = field(default_factory=dict)
    """run.json of each run that could be read, by the run's name."""

    @property
    def tasks(self) -> list[str]:
        """Names of the tasks, in the plan's order."""
        return [task.name for task in self.study.tasks]

    @property
    def variants(self) -> list[str]:
        """Labels of the variants, in the plan's order."""
        return [variant.label for variant in self.study.variants]

    def method(self, variant: str) -> str:
        """Return the method of a variant: that of its runs, or the planned one before they have any."""
        planned = next(one.method for one in self.study.variants if one.label == variant)
        return next((row.method for row in self.runs if row.variant == variant and row.method), planned)

    def runs_of(self, task: str, variant: str) -> list[RunRow]:
        """Return the runs of a variant on a task, by seed."""
        return chosen(self.runs, task, variant)

    def ended(self, task: str, variant: str) -> list[RunRow]:
        """Return the runs of a variant on a task that count in a comparison."""
        return [row for row in self.runs_of(task, variant) if row.has_ended]

    def config(self, task: str, variant: str) -> dict[str, str]:
        """Return the settings of a variant on a task under their dotted names; empty before its first run."""
        return {row.setting: row.value for row in chosen(self.settings, task, variant)}


def chosen(rows: Iterable[Row], task: str, variant: str) -> list[Row]:
    """Return the rows of a variant on a task."""
    return [row for row in rows if row.task == task and row.variant == variant]


def read_results(directory: Path) -> Results:
    """Read every run of a study as it is now; raise ValueError if the folder holds no study."""
    study = read_study(directory)
    results = Results(study)
    for planned in study.runs:
        history, status, reason = _open(directory / planned.run)
        if history is None:
            results.runs.append(_unread(study, planned, status, reason))
            continue
        if not results.config(planned.task, planned.variant):
            results.settings.extend(_setting_rows(planned, history.record))
        results.records[planned.run] = history.record
        results.runs.append(_run_row(study, planned, history, status, reason))
        results.curves.extend(_curve_rows(planned, history))
        results.designs.extend(_design_rows(planned, history))
    return results


def _open(path: Path) -> tuple[History | None, str, str]:
    """Return a run's history, status, and the reason of it."""
    if not path.is_dir():
        return None, "not started", ""
    try:
        history = History(RunFolder(path))
        return history, history.status, history.message
    except RunFolderError as error:
        return None, "unreadable", str(error)
    except (ValueError, OSError) as error:  # numbers that contradict each other, a folder where a file belongs
        return None, "unreadable", f"{path.name} can't be read: {error}"


def _unread(study: Study, planned: PlannedRun, status: str, reason: str) -> RunRow:
    method = next((v.method for v in study.variants if v.label == planned.variant), "")
    return RunRow(**_whose(planned), method=method, status=status, reason=reason)


def _run_row(study: Study, planned: PlannedRun, history: History, status: Status | str, reason: str) -> RunRow:
    config = flattened(history.record.config)
    last = history.progress[-1] if history.progress else None
    sampled = history.first_evaluation("sampled", study.level)
    deterministic = history.first_evaluation("deterministic", study.level)
    moving = [p for p, moved in zip(history.progress, _moved(history), strict=True) if moved]
    loss, cost = _values(moving, "divergence"), _values(moving, "search_cost")
    shown = {name: config.get(name) for name in ("exploration", "search", "projection")}
    return RunRow(
        **_whose(planned),
        method=history.record.method,
        **{name: str(value) if value is not None else None for name, value in shown.items()},
        alpha=_number(config.get("alpha")),
        status=status,
        reason=reason,
        iterations=history.iteration,
        env_steps=last.env_steps if last else 0,
        relabelled_steps=last.relabelled_steps if last else 0,
        search_steps=last.search_steps if last else 0,
        cpu_seconds=history.cpu_seconds,
        sampled_solved_steps=sampled.env_steps if sampled else None,
        sampled_solved_cpu_seconds=sampled.cpu_seconds if sampled else None,
        deterministic_solved_steps=deterministic.env_steps if deterministic else None,
        deterministic_solved_cpu_seconds=deterministic.cpu_seconds if deterministic else None,
        **_end(history.last_evaluation),
        diverged=last.diverged if last else 0,
        negative_share=_mean(_values(moving, "cosine_negative")),
        cosine=_mean(_values(moving, "cosine")),
        divergence_first=_mean(loss[:ENDS]),
        divergence_last=_mean(loss[-ENDS:]),
        search_cost_first=_mean(cost[:ENDS]),
        search_cost_last=_mean(cost[-ENDS:]),
        loss_and_cost_rank=_rank_correlation(moving),
    )


def _end(end: Evaluation | None) -> dict[str, Any]:
    """Return what a run came to, as fields of its row."""
    if end is None:
        return {}
    count = end.episodes
    return {
        "end_episodes": count,
        "end_is_final": end.final,
        "sampled_success": end.sampled_success,
        "sampled_successes": round(end.sampled_success * count) if count else None,
        "sampled_return": end.sampled_return,
        "deterministic_success": end.deterministic_success,
        "deterministic_successes": round(end.deterministic_success * count) if count else None,
        "deterministic_return": end.deterministic_return,
        "milestones": ", ".join(f"{name} {share:.4g}" for name, share in end.milestones.items()),
    }


def _curve_rows(planned: PlannedRun, history: History) -> list[CurveRow]:
    evaluations: dict[int, Evaluation] = {}
    for evaluation in sorted(history.evaluations, key=lambda e: e.final):  # an ordinary one comes before the final one
        evaluations.setdefault(evaluation.iteration, evaluation)
    rows = []
    for progress, moved in zip(history.progress, _moved(history), strict=True):
        after = evaluations.get(progress.iteration)
        measured = {
            name: getattr(after, name)
            for name in ("sampled_success", "sampled_return", "deterministic_success", "deterministic_return")
            if after
        }
        rows.append(
            CurveRow(
                **_whose(planned),
                iteration=progress.iteration,
                env_steps=progress.env_steps,
                relabelled_steps=progress.relabelled_steps,
                search_steps=progress.search_steps,
                cpu_seconds=progress.cpu_seconds,
                episode_return=_number(progress.episode_return),
                success=_number(progress.success),
                phi_moved=moved,
                divergence=_number(progress.divergence),
                search_cost=_number(progress.search_cost),
                cosine=_number(progress.cosine),
                cosine_negative=_number(progress.cosine_negative),
                **measured,
            )
        )
    return rows


def _design_rows(planned: PlannedRun, history: History) -> list[DesignRow]:
    best = history.best.phi if history.best else history.phi.tolist()
    values = zip(history.record.parameters, history.initial_phi.tolist(), history.phi.tolist(), best, strict=False)
    return [
        DesignRow(
            **_whose(planned), parameter=p.name, unit=p.unit, lo=p.lo, hi=p.hi, initial=start, final=now, best=top
        )
        for p, start, now, top in values
    ]


def _setting_rows(planned: PlannedRun, record: RunRecord) -> list[SettingRow]:
    return [
        SettingRow(task=planned.task, variant=planned.variant, setting=name, value=_word(value))
        for name, value in flattened(record.config).items()
    ]


def _word(value: object) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _whose(planned: PlannedRun) -> dict[str, Any]:
    """Return the fields by which every row says of which run it is."""
    return msgspec.structs.asdict(planned)


def _moved(history: History) -> list[bool]:
    """Return for each iteration whether phi moved in it."""
    path = [history.initial_phi.tolist(), *(p.phi for p in history.progress)]
    return [now != before for before, now in itertools.pairwise(path)]


def _values(progress: Sequence[Progress], name: str) -> list[float]:
    found = (_number(getattr(p, name)) for p in progress)
    return [value for value in found if value is not None]


def _rank_correlation(progress: Sequence[Progress]) -> float | None:
    """Return Spearman's correlation of the proxy's loss and the search cost; None where either stands still."""
    from scipy.stats import spearmanr

    pairs = [(_number(p.divergence), _number(p.search_cost)) for p in progress]
    both = [(loss, cost) for loss, cost in pairs if loss is not None and cost is not None]
    if len(both) < 2 * ENDS or np.ptp(both, axis=0).min() == 0:
        return None
    correlation: Any = spearmanr(both)
    return float(correlation.statistic)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _number(value: object) -> float | None:
    """Return a finite number, or None for anything else."""
    with contextlib.suppress(TypeError, ValueError):
        if math.isfinite(number := float(value)):  # pyright: ignore[reportArgumentType]
            return number
    return None
