"""The paper's claims, each with the rule by which the runs of a study say whether it holds here.

A rule needs at least `FEWEST` seeds that have ended. A seed that failed counts, as not solved.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from studio.study.report.results import DesignRow, Results, RunRow, chosen
from studio.study.report.scores import improvement

Verdict = Literal["held", "not held", "not testable"]

FEWEST = 3
"""Seeds that must have ended before anything is said."""
NEGATIVE_SHARE, NEGATIVE_TOLERANCE = 0.64, 0.10
"""The paper's share of gradient steps with a negative cosine, and how far a median may be from it."""
SIMILAR = 0.10
"""Largest difference of the median success of two methods that count as similar."""
LIFTED = 0.5
"""Share of episodes from which on a hand counts as one that lifts the object."""
FALLS_TO = 0.5
"""Share of its first value that a curve must come down to."""
TASKS = ("reacher", "pen_press", "mouse_click")
"""The paper's tasks, as they are called here."""
BASELINES = ("no_hw_opt", "cmaes_rl", "transform2act")


@dataclass(frozen=True)
class Finding:
    """What a study says of a claim, for one variant on one task."""

    verdict: Verdict
    subject: str
    """The task and the variants that were looked at."""
    measured: str
    """Words on how far the claim holds or fails, or on why nothing can be said."""
    seeds: int
    """Seeds that the finding rests on."""


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper, and the rule that judges it."""

    name: str
    statement: str
    where: str
    """Section or figure of the paper."""
    rule: str
    judge: Callable[[Results], Iterator[Finding]]

    def findings(self, results: Results) -> list[Finding]:
        """Return what the study says; never nothing."""
        found = list(self.judge(results))
        return found or [Finding("not testable", "", "this study has no such runs", 0)]


def solved(rows: list[RunRow], level: float) -> int:
    """Return how many runs ended with at least this success."""
    return sum(row.ends_at(level) for row in rows)


def solves(rows: list[RunRow], level: float) -> bool:
    """Tell whether at least half of the runs ended with at least this success."""
    return 2 * solved(rows, level) >= len(rows)


def _counted(rows: list[RunRow], level: float) -> str:
    scores = [row.score for row in rows]
    return (
        f"{solved(rows, level)} of {len(rows)} seeds end at {level:g} or more, median success {np.median(scores):.2f}"
    )


def _subject(task: str, *variants: str) -> str:
    return f"{task}: {' / '.join(variants)}"


def _too_few(task: str, variant: str, rows: list[RunRow], which: str = "that have ended") -> Finding:
    why = f"seeds {which}: {len(rows)}; {FEWEST} are needed"
    return Finding("not testable", _subject(task, variant), why, len(rows))


def _variants_of(results: Results, method: str) -> list[str]:
    return [label for label in results.variants if results.method(label) == method]


def _on_tasks(results: Results, method: str, tasks: tuple[str, ...]) -> Iterator[tuple[str, str, list[RunRow]]]:
    """Yield task, variant and ended runs of every variant of a method on those tasks of the study."""
    for task in results.tasks:
        for variant in _variants_of(results, method) if task in tasks else ():
            yield task, variant, results.ended(task, variant)


def _solving(method: str, tasks: tuple[str, ...], expected: bool) -> Callable[[Results], Iterator[Finding]]:
    """Return the judge of a claim that a method solves, or does not solve, tasks."""

    def judge(results: Results) -> Iterator[Finding]:
        level = results.study.level
        for task, variant, rows in _on_tasks(results, method, tasks):
            if len(rows) < FEWEST:
                yield _too_few(task, variant, rows)
            else:
                verdict = "held" if solves(rows, level) == expected else "not held"
                yield Finding(verdict, _subject(task, variant), _counted(rows, level), len(rows))

    return judge


def _grasps(task: str, lifts: bool) -> Callable[[Results], Iterator[Finding]]:
    """Return the judge of what Transform2Act does with a hand: it fails, having lifted the object or not."""

    def judge(results: Results) -> Iterator[Finding]:
        level = results.study.level
        for _, variant, rows in _on_tasks(results, "transform2act", (task,)):
            shares = [share for row in rows if (share := row.milestone("lifted")) is not None]
            if len(rows) < FEWEST:
                yield _too_few(task, variant, rows)
            elif len(shares) < FEWEST:
                yield Finding("not testable", _subject(task, variant), "lifting was not measured", len(shares))
            else:
                lifted = float(np.median(shares))
                holds = not solves(rows, level) and (lifted >= LIFTED) == lifts
                measured = f"{_counted(rows, level)}, median lifted {lifted:.2f}"
                yield Finding("held" if holds else "not held", _subject(task, variant), measured, len(rows))

    return judge


def projection_is_crucial(results: Results) -> Iterator[Finding]:
    """Compare each variant without projection with those that have one and differ in nothing else."""
    level = results.study.level
    for task in results.tasks:
        for bare, projected in _pairs(results, task):
            without, with_it = results.ended(task, bare), results.ended(task, projected)
            subject, seeds = _subject(task, bare, projected), min(len(without), len(with_it))
            if seeds < FEWEST:
                yield _too_few(task, f"{bare} / {projected}", min(without, with_it, key=len))
                continue
            holds = solves(with_it, level) and not solves(without, level)
            better = improvement([[r.score for r in with_it]], [[r.score for r in without]])
            measured = (
                f"without {solved(without, level)} of {len(without)}, with {solved(with_it, level)} of {len(with_it)} "
                f"seeds solved; P(with > without) = {better}"
            )
            yield Finding("held" if holds else "not held", subject, measured, seeds)


def _pairs(results: Results, task: str) -> Iterator[tuple[str, str]]:
    """Yield pairs of variants, without and with a projection, whose other settings are the same."""
    labels = _variants_of(results, "morph")
    configs = {label: config for label in labels if (config := results.config(task, label))}
    rest = {label: {k: v for k, v in c.items() if k != "projection"} for label, c in configs.items()}
    for bare in configs:
        for other in configs:
            without, with_it = (configs[label].get("projection") for label in (bare, other))
            if without == "none" != with_it and rest[bare] == rest[other]:
                yield bare, other


def _outperforms(tasks: tuple[str, ...], baselines: tuple[str, ...]) -> Callable[[Results], Iterator[Finding]]:
    """Return the judge of a claim that MORPH ends above baselines."""

    def judge(results: Results) -> Iterator[Finding]:
        for task, variant, rows in _on_tasks(results, "morph", tasks):
            if len(rows) < FEWEST:
                yield _too_few(task, variant, rows)
                continue
            duels = [duel for method in baselines for duel in _duels(results, task, rows, method)]
            beaten = [duel.won for duel in duels]
            verdict: Verdict = "not held" if False in beaten else "not testable" if None in beaten else "held"
            said, seeds = "; ".join(duel.words for duel in duels), min(duel.seeds for duel in duels)
            yield Finding(verdict, _subject(task, variant), said, seeds)

    return judge


@dataclass(frozen=True)
class _Duel:
    """How runs of MORPH compare with one baseline."""

    words: str
    won: bool | None
    """Whether they end above it; None where that can't be said."""
    seeds: int
    """Seeds that were compared on both sides; those of MORPH where there was nothing to compare them with."""


def _duels(results: Results, task: str, rows: list[RunRow], method: str) -> Iterator[_Duel]:
    """Compare runs with every variant of a baseline on their task."""
    rivals = _variants_of(results, method)
    if not rivals:
        yield _Duel(f"no {method} in this study", None, len(rows))
    for rival in rivals:
        theirs = results.ended(task, rival)
        if len(theirs) < FEWEST:
            yield _Duel(f"{rival} has too few seeds", None, len(rows))
        else:
            better = improvement([[r.score for r in rows]], [[r.score for r in theirs]])
            yield _Duel(f"P(> {rival}) = {better}", better.low > 0.5, min(len(rows), len(theirs)))


def similar_to_transform2act(results: Results) -> Iterator[Finding]:
    """Compare the median success of each variant of morph with that of Transform2Act on the reacher."""
    for task, variant, rows in _on_tasks(results, "morph", ("reacher",)):
        for rival in _variants_of(results, "transform2act"):
            theirs = results.ended(task, rival)
            if min(len(rows), len(theirs)) < FEWEST:
                yield _too_few(task, f"{variant} / {rival}", min(rows, theirs, key=len))
                continue
            ours, other = (float(np.median([r.score for r in some])) for some in (rows, theirs))
            verdict = "held" if abs(ours - other) <= SIMILAR else "not held"
            measured = f"median success {ours:.2f} against {other:.2f}"
            yield Finding(verdict, _subject(task, variant, rival), measured, min(len(rows), len(theirs)))


def cosine_is_negative(results: Results) -> Iterator[Finding]:
    """Look at the share of gradient steps with a negative cosine while phi moves."""
    for task in results.tasks:
        for variant in _variants_of(results, "morph"):
            rows = [row for row in results.ended(task, variant) if row.negative_share is not None]
            if len(rows) < FEWEST:
                yield _too_few(task, variant, rows, "with a cosine")
                continue
            shares = [row.negative_share for row in rows if row.negative_share is not None]
            middle = float(np.median(shares))
            verdict = "held" if abs(middle - NEGATIVE_SHARE) <= NEGATIVE_TOLERANCE else "not held"
            measured = f"median {100 * middle:.0f} %, seeds {100 * min(shares):.0f} to {100 * max(shares):.0f} %"
            yield Finding(verdict, _subject(task, variant), measured, len(shares))


def loss_and_cost_fall(results: Results) -> Iterator[Finding]:
    """Look at whether the proxy's loss and the search cost fall, and do so together."""
    for task in results.tasks:
        for variant in _variants_of(results, "morph"):
            rows = [row for row in results.ended(task, variant) if row.loss_and_cost_rank is not None]
            if len(rows) < FEWEST:
                yield _too_few(task, variant, rows, "with both curves")
                continue
            fell = sum(_falls_together(row) for row in rows)
            ranks = [row.loss_and_cost_rank for row in rows if row.loss_and_cost_rank is not None]
            measured = f"in {fell} of {len(rows)} seeds, median rank correlation {np.median(ranks):.2f}"
            verdict = "held" if 2 * fell > len(rows) else "not held"
            yield Finding(verdict, _subject(task, variant), measured, len(rows))


def _falls_together(row: RunRow) -> bool:
    ends = (row.divergence_first, row.divergence_last), (row.search_cost_first, row.search_cost_last)
    fell = all(first is not None and last is not None and last <= FALLS_TO * first for first, last in ends)
    return fell and row.loss_and_cost_rank is not None and row.loss_and_cost_rank > 0


def _designs(
    task: str, matches: Callable[[list[DesignRow]], bool], words: str
) -> Callable[[Results], Iterator[Finding]]:
    """Return the judge of a claim on the designs with which runs of morph solve a task."""

    def judge(results: Results) -> Iterator[Finding]:
        for _, variant, rows in _on_tasks(results, "morph", (task,)):
            winners = [row for row in rows if row.ends_at(results.study.level)]
            if len(winners) < FEWEST:
                yield _too_few(task, variant, winners, "that solve the task")
                continue
            designs = chosen(results.designs, task, variant)
            count = sum(matches([d for d in designs if d.run == row.run]) for row in winners)
            verdict = "held" if 2 * count > len(winners) else "not held"
            measured = f"{words} in {count} of {len(winners)} seeds that solve the task"
            yield Finding(verdict, _subject(task, variant), measured, len(winners))

    return judge


def _lengths(design: list[DesignRow]) -> list[DesignRow]:
    return [row for row in design if row.unit == "m"]


def middle_links_shorten(design: list[DesignRow]) -> bool:
    """Tell whether the third and the fourth link are shorter than at the start."""
    lengths = _lengths(design)
    return len(lengths) > 3 and all(row.final < row.initial for row in lengths[2:4])


def one_finger_shortens(design: list[DesignRow]) -> bool:
    """Tell whether a finger is longer than at the start, and another one shorter."""
    changes = [row.final - row.initial for row in _lengths(design)]
    return bool(changes) and min(changes) < 0 < max(changes)


def fingers_grow(design: list[DesignRow]) -> bool:
    """Tell whether fingers are longer than at the start on average."""
    changes = [row.final - row.initial for row in _lengths(design)]
    return bool(changes) and float(np.mean(changes)) > 0


_AT_LEAST_HALF = "At least half of the seeds end with the study's level of success or more, sampled, on Hw-Phy."
_LESS_THAN_HALF = "Fewer than half of the seeds end with the study's level of success or more, sampled, on Hw-Phy."

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "morph-solves",
        "MORPH learns designs and policies that solve the task.",
        "V-A, Figs. 3, 5, 6",
        _AT_LEAST_HALF,
        _solving("morph", TASKS, True),
    ),
    Claim(
        "no-hw-opt-fails",
        "RL without hardware optimisation fails on the initial design.",
        "V-A",
        _LESS_THAN_HALF,
        _solving("no_hw_opt", TASKS, False),
    ),
    Claim(
        "cmaes-rl-fails",
        "CMA-ES with an RL inner loop fails to find a good design in a similar time.",
        "V-A",
        _LESS_THAN_HALF,
        _solving("cmaes_rl", TASKS, False),
    ),
    Claim(
        "transform2act-solves-reacher",
        "Transform2Act solves the reacher too.",
        "V-A, Figs. 3, 7",
        _AT_LEAST_HALF,
        _solving("transform2act", ("reacher",), True),
    ),
    Claim(
        "transform2act-is-similar",
        "Transform2Act reaches a similar performance to MORPH's on the reacher.",
        "V-A, Fig. 7",
        f"The medians of the success at the end differ by at most {SIMILAR:g}.",
        similar_to_transform2act,
    ),
    Claim(
        "transform2act-lifts-pen",
        "On the pen, Transform2Act learns to grasp, but not to press.",
        "V-A, Fig. 5",
        f"{_LESS_THAN_HALF} The median share of episodes that lift the pen is {LIFTED:g} or more.",
        _grasps("pen_press", True),
    ),
    Claim(
        "transform2act-drops-mouse",
        "On the mouse, Transform2Act does not even lift.",
        "V-A, Fig. 6",
        f"{_LESS_THAN_HALF} The median share of episodes that lift the mouse is below {LIFTED:g}.",
        _grasps("mouse_click", False),
    ),
    Claim(
        "morph-beats-search",
        "MORPH does better than RL without hardware optimisation and than CMA-ES with RL on the reacher.",
        "V-A, Fig. 7",
        "The 95 % interval of the probability that a run of MORPH ends with more success lies above .5, for each.",
        _outperforms(("reacher",), ("no_hw_opt", "cmaes_rl")),
    ),
    Claim(
        "morph-beats-all",
        "MORPH outperforms all three baselines on the hands.",
        "V-A, Fig. 8",
        "The 95 % interval of the probability that a run of MORPH ends with more success lies above .5, for each.",
        _outperforms(("pen_press", "mouse_click"), BASELINES),
    ),
    Claim(
        "projection-is-crucial",
        "Gradient projection is crucial: without it MORPH fails to learn.",
        "V-B, Figs. 7, 8",
        "Of two variants that differ in the projection alone, at least half of the seeds end with the study's level of "
        "success or more with it, and fewer than half without it.",
        projection_is_crucial,
    ),
    Claim(
        "cosine-is-negative",
        "The cosine of the two gradients is negative on about 64 % of the steps (mouse).",
        "V-B, Fig. 9 A",
        "Over the iterations in which phi moves, the median over seeds lies within "
        f"{100 * NEGATIVE_TOLERANCE:g} percentage points of {100 * NEGATIVE_SHARE:g} %.",
        cosine_is_negative,
    ),
    Claim(
        "loss-and-cost-fall",
        "The proxy's loss and the search cost start high and fall together (mouse).",
        "V-B, Fig. 9 B",
        f"In more than half of the seeds both fall to at most {FALLS_TO:g} of their start (means of the first and last "
        "five iterations in which phi moves), and their rank correlation over these iterations is positive.",
        loss_and_cost_fall,
    ),
    Claim(
        "reacher-design",
        "The reacher's third and fourth link get shorter.",
        "V-A, Fig. 3",
        "Both are shorter than at the start in more than half of the seeds that solve the task.",
        _designs("reacher", middle_links_shorten, "both links shorter"),
    ),
    Claim(
        "pen-design",
        "For the pen one finger grows to press, and an unused one shortens.",
        "V-A, Fig. 5",
        "One finger is longer and one shorter than at the start in more than half of the seeds that solve the task.",
        _designs("pen_press", one_finger_shortens, "one longer and one shorter"),
    ),
    Claim(
        "mouse-design",
        "For the mouse the fingers grow.",
        "V-A, Fig. 6",
        "Fingers are longer than at the start on average in more than half of the seeds that solve the task.",
        _designs("mouse_click", fingers_grow, "longer"),
    ),
)
