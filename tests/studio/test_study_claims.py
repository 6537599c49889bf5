"""The paper's claims: each rule can come out each way, and says so for a reason that the data hold."""

from collections.abc import Mapping, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studio.study.plan import PlannedTask, Study, Variant
from studio.study.report.claims import CLAIMS, FEWEST, Claim, Finding
from studio.study.report.results import DesignRow, Results, RunRow, SettingRow

BY_NAME = {claim.name: claim for claim in CLAIMS}
LEVEL = 0.9
GOOD, BAD = [1.0] * 5, [0.0] * 5


def run(task: str, label: str, seed: int, success: float, **more: object) -> RunRow:
    fields: dict = {"status": "finished", "method": label.split(",")[0], "sampled_success": success} | more
    return RunRow(task=task, variant=label, seed=seed, run=f"{task}-{label}-s{seed}", **fields)


def results(
    task: str, runs: Mapping[str, Sequence[RunRow]], designs: Sequence[DesignRow] = (), projected: str = ""
) -> Results:
    """Return a study of one task; variants are called METHOD or METHOD,word."""
    variants = [Variant(label, label.split(",")[0]) for label in runs]
    study = Study(
        tasks=[PlannedTask(task)], variants=variants, seeds=[], env_steps=1, level=LEVEL, final_episodes=256, runs=[],
        versions={}, created=0.0,
    )  # fmt: skip
    settings = [
        SettingRow(task=task, variant=label, setting=name, value=value)
        for label in runs
        for name, value in (("projection", "one_sided" if label == projected else "none"), ("K", "1"))
    ]
    return Results(study, [row for rows in runs.values() for row in rows], [], list(designs), settings)


def of(task: str, **successes: Sequence[float]) -> Results:
    """Return a study of methods whose seeds end with these successes."""
    return results(task, {m: [run(task, m, i, s) for i, s in enumerate(some)] for m, some in successes.items()})


def lifting(task: str, success: Sequence[float], lifted: float | None) -> Results:
    words = "" if lifted is None else f"lifted {lifted}"
    rows = [run(task, "transform2act", i, s, milestones=words) for i, s in enumerate(success)]
    return results(task, {"transform2act": rows})


def with_proxy(**fields: object) -> Results:
    return results("mouse_click", {"morph": [run("mouse_click", "morph", i, 1.0, **fields) for i in range(5)]})


def curves(loss: tuple[float, float], cost: tuple[float, float], rank: float | None) -> Results:
    return with_proxy(
        divergence_first=loss[0], divergence_last=loss[1], search_cost_first=cost[0], search_cost_last=cost[1],
        loss_and_cost_rank=rank,
    )  # fmt: skip


def projecting(without: Sequence[float], with_it: Sequence[float]) -> Results:
    rows = {
        label: [run("reacher", label, i, s) for i, s in enumerate(some)]
        for label, some in (("morph,bare", without), ("morph,projected", with_it))
    }
    return results("reacher", rows, projected="morph,projected")


def designs(task: str, final: Sequence[float], success: Sequence[float] = GOOD) -> Results:
    rows = [run(task, "morph", i, s) for i, s in enumerate(success)]
    lengths = [
        DesignRow(
            task=task, variant="morph", seed=row.seed, run=row.run, parameter=f"length_{i}", unit="m", lo=0.0, hi=5.0,
            initial=1.0, final=length, best=length,
        )
        for row in rows
        for i, length in enumerate(final)
    ]  # fmt: skip
    return results(task, {"morph": rows}, lengths)


TWO = GOOD[:2]
CASES: dict[str, tuple[Results, Results, Results]] = {
    # name: held, not held, not testable
    "morph-solves": (of("pen_press", morph=GOOD), of("pen_press", morph=BAD), of("pen_press", morph=TWO)),
    "no-hw-opt-fails": (of("reacher", no_hw_opt=BAD), of("reacher", no_hw_opt=GOOD), of("reacher", no_hw_opt=TWO)),
    "cmaes-rl-fails": (of("reacher", cmaes_rl=BAD), of("reacher", cmaes_rl=GOOD), of("reacher", cmaes_rl=TWO)),
    "transform2act-solves-reacher": (
        of("reacher", transform2act=GOOD),
        of("reacher", transform2act=BAD),
        of("pen_press", transform2act=GOOD),
    ),
    "transform2act-is-similar": (
        of("reacher", morph=GOOD, transform2act=[0.95] * 3),
        of("reacher", morph=GOOD, transform2act=[0.5] * 3),
        of("reacher", morph=GOOD, transform2act=[0.95] * 2),
    ),
    "transform2act-lifts-pen": (
        lifting("pen_press", BAD, 0.9),
        lifting("pen_press", BAD, 0.1),
        lifting("pen_press", BAD, None),
    ),
    "transform2act-drops-mouse": (
        lifting("mouse_click", BAD, 0.1),
        lifting("mouse_click", BAD, 0.9),
        lifting("mouse_click", BAD, None),
    ),
    "morph-beats-search": (
        of("reacher", morph=GOOD, no_hw_opt=BAD, cmaes_rl=BAD),
        of("reacher", morph=GOOD, no_hw_opt=BAD, cmaes_rl=GOOD),
        of("reacher", morph=GOOD, no_hw_opt=BAD),
    ),
    "morph-beats-all": (
        of("pen_press", morph=GOOD, no_hw_opt=BAD, cmaes_rl=BAD, transform2act=BAD),
        of("pen_press", morph=GOOD, no_hw_opt=BAD, cmaes_rl=BAD, transform2act=GOOD),
        of("pen_press", morph=GOOD, no_hw_opt=BAD, cmaes_rl=BAD),
    ),
    "projection-is-crucial": (projecting(BAD, GOOD), projecting(GOOD, GOOD), projecting(BAD, TWO)),
    "cosine-is-negative": (
        with_proxy(negative_share=0.6),
        with_proxy(negative_share=0.4),
        with_proxy(negative_share=None),
    ),
    "loss-and-cost-fall": (
        curves((1, 0.1), (2, 0.2), 0.9),
        curves((1, 0.1), (2, 1.9), 0.9),
        curves((1, 0.1), (2, 0.2), None),
    ),
    "reacher-design": (
        designs("reacher", [1, 1, 0.5, 0.5, 1]),
        designs("reacher", [1, 1, 0.5, 1.5, 1]),
        designs("reacher", [1, 1, 0.5, 0.5, 1], BAD),
    ),
    "pen-design": (designs("pen_press", [0.5, 1.5]), designs("pen_press", [1.5, 1.5]), of("reacher", morph=GOOD)),
    "mouse-design": (
        designs("mouse_click", [1.5, 1.2]),
        designs("mouse_click", [0.5, 1.2]),
        designs("mouse_click", [1.5, 1.2], BAD),
    ),
}


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_a_claim_can_be_held_not_held_and_not_testable(claim: Claim) -> None:
    verdicts = [[finding.verdict for finding in claim.findings(some)] for some in CASES[claim.name]]
    assert verdicts == [["held"], ["not held"], ["not testable"]]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_a_study_without_any_run_holds_nothing(claim: Claim) -> None:
    assert claim.findings(of("reacher")) == [Finding("not testable", "", "this study has no such runs", 0)]


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_runs_that_have_not_ended_say_nothing(claim: Claim) -> None:
    for case in CASES[claim.name]:
        waiting = [
            run(row.task, row.variant, row.seed, 1.0, status="running", milestones=row.milestones) for row in case.runs
        ]
        found = claim.findings(Results(case.study, waiting, [], case.designs, case.settings))
        assert {finding.verdict for finding in found} == {"not testable"}


def test_a_failed_seed_counts_as_not_solved() -> None:
    failed = [run("reacher", "morph", i, 1.0, status="failed") for i in range(3)]
    mixed = results("reacher", {"morph": [*failed, run("reacher", "morph", 3, 1.0), run("reacher", "morph", 4, 1.0)]})
    (finding,) = BY_NAME["morph-solves"].findings(mixed)
    assert (finding.verdict, finding.measured) == ("not held", "2 of 5 seeds end at 0.9 or more, median success 0.00")


def test_a_baseline_that_is_missing_leaves_it_open_but_one_that_is_not_beaten_decides() -> None:
    claim = BY_NAME["morph-beats-all"]
    (open_,) = claim.findings(of("pen_press", morph=GOOD, no_hw_opt=BAD))
    assert open_.verdict == "not testable"
    assert "no cmaes_rl in this study" in open_.measured
    (decided,) = claim.findings(of("pen_press", morph=GOOD, no_hw_opt=GOOD))
    assert decided.verdict == "not held"


def test_being_better_by_chance_is_not_better() -> None:
    (finding,) = BY_NAME["morph-beats-search"].findings(
        of("reacher", morph=[0.0, 0.6, 0.6, 0.6], no_hw_opt=[0.0, 0.5, 0.7], cmaes_rl=[0.0] * 4)
    )
    assert finding.verdict == "not held"
    assert "P(> no_hw_opt) = 0.54 [" in finding.measured


def test_variants_that_differ_in_more_than_the_projection_are_no_pair() -> None:
    pair = projecting(BAD, GOOD)
    other = [
        row if row.setting != "K" or row.variant != "morph,bare" else SettingRow(
            task=row.task, variant=row.variant, setting="K", value="2"
        )
        for row in pair.settings
    ]  # fmt: skip
    (finding,) = BY_NAME["projection-is-crucial"].findings(Results(pair.study, pair.runs, [], [], other))
    assert finding.subject == ""


@pytest.mark.parametrize(
    ("fields", "verdict"),
    [
        ({"negative_share": 0.74}, "held"),
        ({"negative_share": 0.75}, "not held"),
        ({"negative_share": 0.54}, "held"),
        ({"negative_share": 0.53}, "not held"),
    ],
)
def test_the_negative_share_may_differ_by_ten_points(fields: dict, verdict: str) -> None:
    (finding,) = BY_NAME["cosine-is-negative"].findings(with_proxy(**fields))
    assert finding.verdict == verdict


@pytest.mark.parametrize(
    "case", [curves((1, 0.6), (2, 0.2), 0.9), curves((1, 0.1), (2, 0.2), -0.1), curves((1, 2.0), (1, 2.0), 0.9)]
)
def test_loss_and_cost_must_both_halve_and_do_so_together(case: Results) -> None:
    (finding,) = BY_NAME["loss-and-cost-fall"].findings(case)
    assert finding.verdict == "not held"


SUCCESSES = st.lists(st.floats(0, 1), min_size=0, max_size=8)


def expected(successes: Sequence[float], at_least_half: bool) -> str:
    if len(successes) < FEWEST:
        return "not testable"
    return "held" if (sum(s >= LEVEL for s in successes) >= len(successes) / 2) == at_least_half else "not held"


@settings(max_examples=60)
@given(SUCCESSES)
def test_solving_and_failing_are_opposites_by_the_share_of_seeds(successes: list[float]) -> None:
    (solves,) = BY_NAME["morph-solves"].findings(of("reacher", morph=successes))
    (fails,) = BY_NAME["no-hw-opt-fails"].findings(of("reacher", no_hw_opt=successes))
    assert solves.verdict == expected(successes, True)
    assert fails.verdict == expected(successes, False)
    assert solves.seeds == fails.seeds == len(successes)


@settings(max_examples=30)
@given(SUCCESSES, SUCCESSES)
def test_projection_is_crucial_only_where_its_lack_makes_the_difference(
    without: list[float], with_it: list[float]
) -> None:
    (finding,) = BY_NAME["projection-is-crucial"].findings(projecting(without, with_it))
    verdicts = expected(with_it, True), expected(without, False)
    if "not testable" in verdicts:
        assert finding.verdict == "not testable"
    else:
        assert finding.verdict == ("held" if verdicts == ("held", "held") else "not held")


@settings(max_examples=40)
@given(st.lists(st.one_of(st.none(), st.floats(0, 1)), max_size=8), st.sampled_from([c.name for c in CLAIMS]))
def test_a_verdict_never_rests_on_fewer_seeds_than_are_needed(shares: list[float | None], name: str) -> None:
    rows = [
        run("mouse_click", "morph", i, share or 0.0, negative_share=share, loss_and_cost_rank=share)
        for i, share in enumerate(shares)
    ]
    for finding in BY_NAME[name].findings(results("mouse_click", {"morph": rows})):
        assert finding.seeds >= FEWEST or finding.verdict == "not testable"


def test_every_claim_has_a_rule_and_a_place_in_the_paper() -> None:
    assert set(CASES) == set(BY_NAME)
    assert len(BY_NAME) == len(CLAIMS)
    for claim in CLAIMS:
        assert claim.rule.endswith(".")
        assert claim.statement.endswith(".")
        assert claim.where.startswith("V-")
