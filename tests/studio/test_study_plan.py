"""The plan of a study: what its words mean, what is refused, and a folder that is there whole or not at all."""

import string
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morph_core.history import History
from morph_core.run_folder import RUN_ID, RunFolder, list_runs
from studio.cli import run
from studio.study.plan import (
    PlannedTask,
    Study,
    StudyError,
    Variant,
    differences,
    parse_seeds,
    parse_task,
    parse_variant,
    plan_study,
    read_study,
    write_study,
)

TINY = "trajectories=8,evaluation.episodes=4"


def planned(*words: str, seeds: str = "0-1", **more: object) -> Study:
    wishes: dict = {"env_steps": 1000, "final_episodes": 8} | more
    return plan_study([parse_task("reacher")], [parse_variant(word) for word in words], parse_seeds(seeds), **wishes)


NO_WORDS = ("true", "false", "nan", "inf", "infinity")
names = st.text(string.ascii_lowercase + "_.", min_size=1).filter(lambda name: name.strip("."))
values = st.one_of(
    st.integers(-(10**6), 10**6), st.booleans(), st.floats(-1e6, 1e6),
    st.text(string.ascii_letters, min_size=1).filter(lambda word: word.lower() not in NO_WORDS),
)  # fmt: skip
labels = st.text(
    st.characters(blacklist_characters=":,=", whitelist_categories=["L", "N", "P", "S"]), min_size=1, max_size=200
).filter(lambda label: any(c.isalnum() for c in label))


def as_word(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@given(st.none() | labels, st.sampled_from(["morph", "direct"]), st.dictionaries(names, values, max_size=4))
def test_a_method_word_says_label_method_and_settings(label: str | None, method: str, chosen: dict) -> None:
    word = ",".join([method, *(f"{name}={as_word(value)}" for name, value in chosen.items())])
    found = parse_variant(word if label is None else f"{label}:{word}")
    assert found == Variant(word if label is None else label, method, chosen)


@given(st.sets(st.integers(0, 300), min_size=1, max_size=40), st.randoms())
def test_seeds_are_the_numbers_and_ranges_in_whatever_order(seeds: set[int], random) -> None:
    parts, left = [], sorted(seeds)
    while left:
        run_length = 1
        while run_length < len(left) and left[run_length] == left[0] + run_length:
            run_length += 1
        parts.append(f"{left[0]}-{left[run_length - 1]}" if run_length > 1 else str(left[0]))
        left = left[run_length:]
    random.shuffle(parts)
    assert parse_seeds(",".join(parts)) == sorted(seeds)


@settings(max_examples=25)
@given(st.lists(labels, min_size=1, max_size=5, unique=True), st.integers(1, 3))
def test_every_run_has_a_name_of_its_own_that_the_studio_accepts(found: list[str], seeds: int) -> None:
    variants = [Variant(label, "no_hw_opt", {"trajectories": 8}) for label in found]
    study = plan_study([PlannedTask("reacher")], variants, range(seeds), env_steps=1000)
    names = [planned.run for planned in study.runs]
    assert len({name.lower() for name in names}) == len(names) == len(found) * seeds
    assert all(RUN_ID.fullmatch(name) for name in names)
    assert {(planned.variant, planned.seed) for planned in study.runs} == {(f, s) for f in found for s in range(seeds)}


def test_a_plan_is_written_with_a_run_folder_for_each_run(tmp_path: Path) -> None:
    study = planned(f"small:morph,{TINY},alpha=.3", f"no_hw_opt,{TINY}")
    assert write_study(tmp_path / "deep" / "study", study) == study
    directory = tmp_path / "deep" / "study"
    assert read_study(directory) == study
    assert [planned.run for planned in study.runs] == [
        "reacher-small-s0", "reacher-no_hw_opt-trajectories-8-evaluation.episodes-4-s0",
        "reacher-small-s1", "reacher-no_hw_opt-trajectories-8-evaluation.episodes-4-s1",
    ]  # fmt: skip
    assert list_runs(directory) == sorted(planned.run for planned in study.runs)
    history = History(RunFolder(directory / "reacher-small-s1"))
    record = history.record
    assert (record.method, record.seed, record.env_steps, record.final_episodes) == ("morph", 1, 1000, 8)
    assert (record.config["alpha"], record.config["trajectories"]) == (0.3, 8)
    assert history.status == "queued"
    assert record.iterations == 125, "an episode has a step at least"


def test_a_preset_is_a_method_with_its_settings(tmp_path: Path) -> None:
    study = planned(f"paper,{TINY},projection=none", f"letter:paper,{TINY}")
    assert study.variants[0] == Variant(
        f"paper,{TINY},projection=none", "morph", {**study.variants[1].settings, "projection": "none"}, "paper"
    )
    write_study(tmp_path / "study", study)
    config = RunFolder(tmp_path / "study" / study.runs[0].run).record().config
    assert config["exploration"]["name"] == "gaussian"  # pyright: ignore
    assert (config["projection"], config["trajectories"]) == ("none", 8)
    assert RunFolder(tmp_path / "study" / "reacher-letter-s1").record().config["projection"] == "one_sided"


def test_a_task_word_sets_options(tmp_path: Path) -> None:
    study = plan_study([parse_task("reacher,z=joints")], [parse_variant(f"morph,{TINY}")], [0], env_steps=1000)
    write_study(tmp_path / "study", study)
    assert RunFolder(tmp_path / "study" / study.runs[0].run).record().task_options == {"z": "joints"}


def test_the_same_plan_goes_on_and_makes_what_is_missing(tmp_path: Path) -> None:
    study = planned(f"direct,{TINY}")
    write_study(tmp_path / "study", study)
    created = RunFolder(tmp_path / "study" / study.runs[0].run).record().created
    missing = tmp_path / "study" / study.runs[1].run
    missing.rename(tmp_path / "elsewhere")
    later = msgspec.structs.replace(planned(f"direct,{TINY}"), versions={"python": "9"})
    assert write_study(tmp_path / "study", later) == study
    assert (missing / "run.json").exists()
    assert RunFolder(tmp_path / "study" / study.runs[0].run).record().created == created


def test_another_plan_there_is_refused_with_the_differences(tmp_path: Path) -> None:
    write_study(tmp_path / "study", planned(f"a:direct,{TINY}"))
    before = contents(tmp_path)
    other = planned(f"a:direct,{TINY},step=2", seeds="0-2", level=0.9)
    with pytest.raises(StudyError) as refusal:
        write_study(tmp_path / "study", other)
    for part in (
        "seeds: 0, 1 there, 0, 1, 2 asked for",
        "level: 0.95 there, 0.9 asked for",
        "a:direct,trajectories=8,evaluation.episodes=4,step=2 asked for",
        "--out",
    ):
        assert part in str(refusal.value)
    assert "env_steps" not in str(refusal.value)
    assert contents(tmp_path) == before


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(p): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("there", ["notes.txt", "20260101-000000-reacher-morph-s0/run.json", ".hidden"])
def test_a_folder_with_anything_else_is_refused_and_not_touched(tmp_path: Path, there: str) -> None:
    path = tmp_path / "study" / there
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(StudyError, match=r"holds other files .*: give --out a new or an empty folder"):
        write_study(tmp_path / "study", planned(f"direct,{TINY}"))
    assert contents(tmp_path) == before


def test_an_empty_folder_is_taken_and_a_file_is_not(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    write_study(tmp_path / "empty", planned(f"direct,{TINY}"))
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StudyError, match="is no folder"):
        write_study(tmp_path / "file", planned(f"direct,{TINY}"))
    with pytest.raises(StudyError, match="can't be written to"):
        write_study(tmp_path / "file" / "below", planned(f"direct,{TINY}"))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "holds no study: there is no study.json"),
        ("{", "can't be read"),
        ('{"format": 2}', "has format 2; this version knows up to 1"),
        ("[]", "can't be read"),
    ],
)
def test_a_folder_without_a_plan_that_can_be_read_says_so(tmp_path: Path, text: str | None, sentence: str) -> None:
    if text is not None:
        (tmp_path / "study.json").write_text(text)
    with pytest.raises(StudyError, match=sentence):
        read_study(tmp_path)


def test_versions_and_time_are_no_difference() -> None:
    study = planned(f"direct,{TINY}")
    assert not list(differences(study, msgspec.structs.replace(study, versions={}, created=0.0)))


REFUSED = [
    ("reacher --methods direct --env-steps 1e5", "--out is missing"),
    ("reacher --methods direct --out study", "--env-steps is missing"),
    ("--methods direct --env-steps 1e5 --out study", "at least one task"),
    ("reacher --env-steps 1e5 --out study", "at least one method"),
    ("reech --methods direct --env-steps 1e5 --out study", 'unknown task "reech"; choose from: reacher, pen_press'),
    ("reacher --methods morhp --env-steps 1e5 --out study", 'unknown method "morhp"; choose from: morph, '),
    ("reacher --methods morph,alpha --env-steps 1e5 --out study", "write setting=value"),
    ("reacher --methods morph,alpha=1,alpha=2 --env-steps 1e5 --out study", "sets alpha twice"),
    ("reacher --methods morph,alpha=-1 --env-steps 1e5 --out study", "alpha must lie in [0, 1000000], not -1"),
    ("reacher --methods direct,alpha=1 --env-steps 1e5 --out study", '"alpha" does nothing for direct, only for'),
    ("reacher,tunnle=1 --methods direct --env-steps 1e5 --out study", 'has no option "tunnle"; choose from'),
    ("reacher reacher --methods direct --env-steps 1e5 --out study", 'have the task "reacher"'),
    ("reacher --methods direct direct --env-steps 1e5 --out study", 'have the label "direct"; name each by LABEL:'),
    ("reacher --methods :direct --env-steps 1e5 --out study", "a label needs a letter or a digit"),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds", "--seeds needs a value"),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds ,", "there are no seeds"),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds 5-2", "ends before it begins"),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds 0-1000", "at most 1000 seeds"),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds x", 'ranges such as 0-9,20, not "x"'),
    ("reacher --methods direct --env-steps 1e5 --out study --seeds 4294967296", "seed must be a whole number from 0"),
    ("reacher --methods direct --env-steps 7679 --out study", "takes up to 7680 (128 trajectories of 60 steps)"),
    ("reacher --methods direct --env-steps 0.5 --out study", "env_steps must be a whole number from 1"),
    ("reacher --methods direct --env-steps 1e5 --out study --level 0", "level must lie in (0, 1], not 0"),
    ("reacher --methods direct --env-steps 1e5 --out study --final-episodes -1", "final_episodes must be a whole"),
    (
        "reacher --methods direct --env-steps 1e5 --out study --launcher ray",
        'unknown launcher "ray"; choose from: local',
    ),
    (
        "reacher --methods direct --env-steps 1e5 --out study --slots 0",
        "slots must be a whole number from 1 to 1024, not 0",
    ),
    ("--status nowhere", "nowhere holds no study"),
    ("--cancel nowhere", "nowhere holds no study"),
    ("--report nowhere", "nowhere holds no study"),
    ("--status a --cancel b", "goes alone"),
    ("reacher --status a", "--status DIR goes alone"),
]


@pytest.mark.parametrize(("words", "sentence"), REFUSED, ids=[words for words, _ in REFUSED])
def test_what_is_not_possible_is_refused_in_one_line(
    words: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["study", *words.split()]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert sentence in said.err
    assert len(said.err.splitlines()) == 1, said.err
    assert list(tmp_path.iterdir()) == [], "nothing was written"


def test_a_budget_is_checked_against_the_longest_iteration() -> None:
    least = parse_variant(f"direct,{TINY}")
    task = [parse_task("reacher")]
    assert plan_study(task, [least], [0], env_steps=480)
    with pytest.raises(StudyError, match=r"below one iteration of direct,.* on reacher, which takes up to 480"):
        plan_study(task, [least], [0], env_steps=479)
