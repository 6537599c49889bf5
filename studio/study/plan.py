"""The plan of a study: which tasks, which methods with which settings, which seeds; written once as study.json."""

import contextlib
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from morph_core import durable, inside
from morph_core.catalogue import METHODS, TASKS, make_method, make_task
from morph_core.presets import PRESETS
from morph_core.protocol import RunRecord
from morph_core.run_folder import STUDY, RunFolder, RunFolderError, create_run
from studio import limits
from studio.new_run import Machine, StartRun, machine, record_of

FORMAT = 1
LARGEST_PLAN = 16 << 20
"""Bytes of the largest plan that is read: one of 100,000 runs has less."""
MOST_SEEDS = 1000
MOST_RUNS = 10_000
_SLUG = 60
"""Number of characters of a label that stand in the name of a run."""


class StudyError(ValueError):
    """A study that can't be planned, read or written as it is asked for; says what is allowed."""


class PlannedTask(msgspec.Struct, frozen=True):
    """A task of a study."""

    name: str
    options: dict[str, object] = {}
    """Fields of the task's own dataclass that differ from its defaults."""


class Variant(msgspec.Struct, frozen=True):
    """A method of a study with its settings, under the label by which tables and figures call it."""

    label: str
    method: str
    settings: dict[str, object] = {}
    """Settings under dotted names, beside those of the preset and what was found to work for the task."""
    preset: str | None = None
    """Preset that the method's settings begin with; None for none."""


class PlannedRun(msgspec.Struct, frozen=True):
    """A run of a study: the name of its folder, and what it is a run of."""

    run: str
    task: str
    variant: str
    """Label of the variant."""
    seed: int


class Study(msgspec.Struct, frozen=True, kw_only=True):
    """Content of study.json."""

    format: int = FORMAT
    tasks: list[PlannedTask]
    variants: list[Variant]
    seeds: list[int]
    env_steps: int
    """Budget of every run: it ends after the iteration that reaches it."""
    level: float
    """Success of the sampled policy in an evaluation that counts as solved."""
    final_episodes: int
    """Episodes of each kind, sampled and deterministic, in the evaluation at the end of every run."""
    runs: list[PlannedRun]
    versions: dict[str, str]
    created: float

    def variant(self, label: str) -> Variant:
        """Return the variant with this label."""
        return next(variant for variant in self.variants if variant.label == label)

    def task(self, name: str) -> PlannedTask:
        """Return the task with this name."""
        return next(task for task in self.tasks if task.name == name)


# --- what was asked for -----------------------------------------------------------------------------------------------


def parse_task(word: str) -> PlannedTask:
    """Return the task of TASK,option=value,...; raise ValueError that says what is allowed."""
    name, options = _settings_of(word)
    if name not in TASKS:
        raise StudyError(f'unknown task "{name[:40]}"; choose from: {", ".join(TASKS)}')
    return PlannedTask(name, options)


def parse_variant(word: str) -> Variant:
    """Return the variant of METHOD,setting=value,... or PRESET,setting=value,... with LABEL: before it or not.

    Raise ValueError that says what is allowed.
    """
    label, colon, rest = word.partition(":")
    if not colon or "," in label or "=" in label:
        label, rest = word, word
    label = label.strip()
    if not re.search(r"\w", label) or not label.isprintable() or len(label) > 200:
        raise StudyError(f'a label needs a letter or a digit, and at most 200 characters, not "{label[:40]}"')
    name, settings = _settings_of(rest)
    if name in PRESETS:
        return Variant(label, PRESETS[name].method, settings, name)
    if name not in METHODS:
        raise StudyError(
            f'unknown method "{name[:40]}"; choose from: {", ".join(METHODS)}, or a preset: {", ".join(PRESETS)}'
        )
    return Variant(label, name, settings)


def parse_seeds(words: str) -> list[int]:
    """Return the seeds of "0-9,20", ascending; raise ValueError that says what is allowed."""
    seeds: set[int] = set()
    for part in filter(None, (part.strip() for part in words.split(","))):
        match = re.fullmatch(r"([0-9]{1,10})(?:-([0-9]{1,10}))?", part)
        if not match:
            raise StudyError(f'seeds are whole numbers and ranges such as 0-9,20, not "{part[:40]}"')
        first, last = (limits.seed(int(found)) for found in (match[1], match[2] or match[1]))
        if last < first:
            raise StudyError(f"the range of seeds {part} ends before it begins")
        if last - first >= MOST_SEEDS:
            raise StudyError(f"a study has at most {MOST_SEEDS} seeds, not {part}")
        seeds |= set(range(first, last + 1))
    if not seeds:
        raise StudyError("there are no seeds: give some, such as --seeds 0-9,20")
    if len(seeds) > MOST_SEEDS:
        raise StudyError(f"a study has at most {MOST_SEEDS} seeds, not {len(seeds)}")
    return sorted(seeds)


def _settings_of(word: str) -> tuple[str, dict[str, object]]:
    """Return the name and the settings of NAME,setting=value,..."""
    name, *parts = (part.strip() for part in word.split(","))
    settings: dict[str, object] = {}
    for part in parts:
        path, equals, value = part.partition("=")
        if not equals or not path or not value:
            raise StudyError(f'"{part[:60]}" in "{word[:60]}" is no setting: write setting=value')
        if path in settings:
            raise StudyError(f'"{word[:60]}" sets {path} twice')
        settings[path.replace("-", "_")] = _value(value)
    return name, settings


def _value(word: str) -> object:
    """Return a number or true or false as such, anything else as the word that it is."""
    if word in ("true", "false"):
        return word == "true"
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(word)
    return word


def plan_study(
    tasks: Sequence[PlannedTask],
    variants: Sequence[Variant],
    seeds: Sequence[int],
    *,
    env_steps: int,
    level: float = 0.95,
    final_episodes: int = 256,
) -> Study:
    """Return the plan of all tasks with all variants and seeds; raise ValueError that says what is allowed.

    Everything is checked: whatever a run's folder would be refused for, the plan is refused for.
    """
    if not tasks or not variants:
        raise StudyError(f"a study needs at least one {'method' if tasks else 'task'}")
    if twice := _twice([task.name for task in tasks]):
        raise StudyError(f'two of the study have the task "{twice}"')
    if twice := _twice([variant.label for variant in variants]):
        raise StudyError(f'two of the study have the label "{twice}"; name each by LABEL:METHOD,setting=value')
    if not 0 < level <= 1:
        raise StudyError(f"level must lie in (0, 1], not {level:g}")
    if len(tasks) * len(variants) * len(seeds) > MOST_RUNS:
        raise StudyError(f"a study has at most {MOST_RUNS} runs, not {len(tasks) * len(variants) * len(seeds)}")
    names = _names([(task.name, variant.label) for task in tasks for variant in variants])
    here = machine()
    study = Study(
        tasks=list(tasks),
        variants=list(variants),
        seeds=list(seeds),
        env_steps=limits.env_steps(env_steps),
        level=level,
        final_episodes=limits.final_episodes(final_episodes),
        runs=[
            PlannedRun(f"{names[task.name, variant.label]}-s{seed}", task.name, variant.label, seed)
            for seed in seeds  # a seed of every variant before the next one: there is early something to compare
            for task in tasks
            for variant in variants
        ],
        versions=here.versions,
        created=time.time(),
    )
    for _ in _records(msgspec.structs.replace(study, runs=study.runs[: len(tasks) * len(variants)]), here):
        pass
    return study


def _twice(names: Sequence[str]) -> str:
    """Return a name that stands there more than once, or nothing."""
    return next((name for name in names if names.count(name) > 1), "")


def _names(pairs: Sequence[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """Return a name for each task and label, all of them different, that a run folder may begin with."""
    names: dict[tuple[str, str], str] = {}
    for task, label in pairs:
        base = f"{task}-{_slug(label)}"
        others = {name.lower() for name in names.values()}
        free = (base if n == 1 else f"{base}-{n}" for n in range(1, len(pairs) + 2))
        names[task, label] = next(name for name in free if name.lower() not in others)
    return names


def _slug(label: str) -> str:
    return re.sub(r"[^A-Za-z0-9._]+", "-", label)[:_SLUG].strip("-.") or "variant"


# --- its folder -------------------------------------------------------------------------------------------------------


def read_study(directory: Path) -> Study:
    """Return the plan of a study's folder; raise StudyError that says why there is none that can be read."""
    try:
        text = inside.read(directory, STUDY, LARGEST_PLAN)
        found = msgspec.json.decode(text, type=dict[str, object]).get("format")
        if isinstance(found, int) and found > FORMAT:
            raise StudyError(
                f"{directory / STUDY} has format {found}; this version knows up to {FORMAT}: "
                "open it with a newer morph-studio"
            )
        return msgspec.json.decode(text, type=Study)
    except (FileNotFoundError, NotADirectoryError):
        raise StudyError(f"{directory} holds no study: there is no {STUDY} in it") from None
    except StudyError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise StudyError(f"{directory / STUDY} can't be read: {error}") from error


def write_study(directory: Path, study: Study) -> Study:
    """Write a study's folder with all its run folders, or go on with the one that is there; return its plan.

    Raise StudyError, nothing touched, where the folder holds anything else: other files, or another plan.
    """
    study = _placed(directory, study)
    for record in _records(study, machine()):
        folder = RunFolder(directory / record.id)
        if not folder.path.exists():
            try:
                create_run(directory, record)
            except RunFolderError:
                if not folder.path.exists():  # not written by another process of this study meanwhile
                    raise
    return study


def _placed(directory: Path, study: Study) -> Study:
    """Return the plan that stands in the folder: this one, written now, or an earlier one that is the same."""
    if not (directory / STUDY).exists():
        if directory.exists() and not directory.is_dir():
            raise StudyError(f"{directory} is no folder: give --out a new or an empty one")
        if directory.is_dir() and (others := sorted(path.name for path in directory.iterdir())):
            raise StudyError(
                f"{directory} holds other files ({', '.join(others[:3])}{', ...' if len(others) > 3 else ''}): "
                "give --out a new or an empty folder"
            )
        try:
            directory.parent.mkdir(parents=True, exist_ok=True)
            with durable.new_folder(directory) as draft:
                (draft / STUDY).write_bytes(msgspec.json.format(msgspec.json.encode(study), indent=2))
            return study
        except OSError as error:
            if not (directory / STUDY).exists():  # no other process was faster
                raise StudyError(f"the study can't be written to {directory}: {error.strerror or error}") from error
    there = read_study(directory)
    if different := list(differences(there, study)):
        raise StudyError(
            f"{directory} holds another study ({'; '.join(different)}): give the same words, or another --out"
        )
    return there


def differences(there: Study, asked: Study) -> Iterator[str]:
    """Yield in words what of a plan that is there is not as asked for; versions and time are no difference."""
    for name in ("tasks", "variants", "seeds", "env_steps", "level", "final_episodes"):
        before, now = getattr(there, name), getattr(asked, name)
        if before != now:
            what = "methods" if name == "variants" else name
            yield f"{what}: {_in_words(before)} there, {_in_words(now)} asked for"


def _in_words(value: object) -> str:
    if not isinstance(value, list):
        return f"{value:g}" if isinstance(value, float) else str(value)
    words = []
    for one in value:
        match one:
            case PlannedTask(name=name, options=settings):
                words.append(_word(name, settings))
            case Variant(label=label, method=method, settings=settings, preset=preset):
                word = _word(preset or method, settings)
                words.append(word if word == label else f"{label}:{word}")
            case _:
                words.append(str(one))
    return ", ".join(words) if len(words) <= 12 else f"{', '.join(words[:10])}, ... {words[-1]} ({len(words)})"


def _word(name: str, settings: Mapping[str, object]) -> str:
    return ",".join([name, *(f"{path}={value}" for path, value in settings.items())])


def _records(study: Study, here: Machine) -> Iterator[RunRecord]:
    """Yield the record of each run; raise ValueError that says what is allowed."""
    for planned in study.runs:
        task, variant = study.task(planned.task), study.variant(planned.variant)
        yield _record(study, planned, task, variant, here)


def _record(study: Study, planned: PlannedRun, task: PlannedTask, variant: Variant, here: Machine) -> RunRecord:
    try:
        made = make_task(task.name, task.options)
        method = make_method(variant.method, made, variant.settings, variant.preset)
    except (ValueError, TypeError, OverflowError) as error:
        raise StudyError(f"{variant.label} on {task.name}: {error}") from error
    longest = method.trajectories * made.horizon
    if study.env_steps < longest:
        raise StudyError(
            f"the budget of {study.env_steps} environment steps is below one iteration of {variant.label} on "
            f"{task.name}, which takes up to {longest} ({method.trajectories} trajectories of {made.horizon} steps)"
        )
    wish = StartRun(
        task=task.name,
        task_options=task.options,
        method=variant.method,
        preset=variant.preset,
        settings=variant.settings,
        seed=planned.seed,
        iterations=limits.iterations_within(study.env_steps, method.trajectories),
        env_steps=study.env_steps,
        final_episodes=study.final_episodes,
        costly=True,  # a study is cancelled as a whole, and its trainers obey signals
    )
    return msgspec.structs.replace(record_of(wish, made_on=here), id=planned.run)
